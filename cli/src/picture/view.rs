//! Projection of a room onto a picture.

use glam::DVec3;

use super::canvas::Pixel;

/// View of a room: axes to the right and up, position and scale.
pub(super) struct View {
    /// Axis to the right and axis up.
    pub across: usize,
    pub up: usize,
    /// Upper left corner of the room, pixels.
    pub corner: Pixel,
    /// Scale, pixels per metre.
    pub per_m: f64,
    pub size_m: DVec3,
}

impl View {
    /// Projects a point of the room to a pixel.
    pub fn project(&self, p: DVec3) -> Pixel {
        [
            self.corner[0] + p[self.across] * self.per_m,
            self.corner[1] + (self.size_m[self.up] - p[self.up]) * self.per_m,
        ]
    }

    /// Width of the room, pixels.
    pub fn width(&self) -> f64 {
        self.size_m[self.across] * self.per_m
    }

    /// Height of the room, pixels.
    pub fn height(&self) -> f64 {
        self.size_m[self.up] * self.per_m
    }

    /// Returns whether the room is seen from above.
    pub fn is_plan(&self) -> bool {
        self.up == 1
    }

    /// Upper left and lower right corner of the room, pixels.
    pub fn bounds(&self) -> [Pixel; 2] {
        [self.corner, [self.corner[0] + self.width(), self.corner[1] + self.height()]]
    }

    /// Corners of a box in the room, pixels.
    pub fn rectangle(&self, low: DVec3, high: DVec3) -> Vec<Pixel> {
        let ([x0, y1], [x1, y0]) = (self.project(low), self.project(high));
        vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    }
}
