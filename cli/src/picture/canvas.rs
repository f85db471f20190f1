//! Something to draw on: lines, areas and words in pixels.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke, StrokeDash,
    Transform,
};

use crate::files;

/// A place in pixels, to the right and down.
pub type Pixel = [f64; 2];

/// A colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ink {
    /// Red, green, blue.
    pub rgb: [u8; 3],
    /// 0 is nothing, 1 hides what is behind.
    pub opacity: f64,
}

impl Ink {
    /// One that hides what is behind.
    pub const fn solid(rgb: [u8; 3]) -> Self {
        Ink { rgb, opacity: 1.0 }
    }

    /// The same, fainter.
    pub fn faint(self, opacity: f64) -> Self {
        Ink { opacity, ..self }
    }

    /// The same, nearer to black.
    pub fn darker(self, by: f64) -> Self {
        Ink { rgb: self.rgb.map(|c| (f64::from(c) * (1.0 - by)) as u8), ..self }
    }

    fn paint(self) -> Paint<'static> {
        let [r, g, b] = self.rgb;
        let mut paint = Paint { anti_alias: true, ..Paint::default() };
        paint.set_color(Color::from_rgba8(r, g, b, (255.0 * self.opacity.clamp(0.0, 1.0)).round() as u8));
        paint
    }
}

/// Style of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    /// Colour.
    pub ink: Ink,
    /// Width, pixels.
    pub width: f64,
    /// In dashes.
    pub is_dashed: bool,
}

/// A size of letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Letters {
    /// 16 pixels high.
    Small,
    /// 24 pixels high, bold.
    Title,
}

impl Letters {
    fn font(self) -> (FontWeight, RasterHeight) {
        match self {
            Letters::Small => (FontWeight::Regular, RasterHeight::Size16),
            Letters::Title => (FontWeight::Bold, RasterHeight::Size24),
        }
    }

    /// Width and height of a line of text, pixels.
    pub fn size(self, line: &str) -> [f64; 2] {
        let (weight, height) = self.font();
        [(get_raster_width(weight, height) * line.chars().count()) as f64, height.val() as f64]
    }
}

/// A picture in the making.
pub struct Canvas {
    pixels: Pixmap,
}

impl Canvas {
    /// A white one.
    ///
    /// # Errors
    /// The width or the height is zero, or both are too large.
    pub fn new(width: f64, height: f64) -> anyhow::Result<Self> {
        let mut pixels = Pixmap::new(width.ceil() as u32, height.ceil() as u32).context("the picture has no size")?;
        pixels.fill(Color::WHITE);
        Ok(Canvas { pixels })
    }

    /// Fills areas that together are one: where they overlap the colour is as where they do not.
    pub fn fill(&mut self, areas: &[Vec<Pixel>], ink: Ink) {
        let mut path = PathBuilder::new();
        for area in areas {
            // All the same way round, so that none is taken for a hole in another.
            let turned: Vec<Pixel> =
                if signed_area(area) < 0.0 { area.iter().rev().copied().collect() } else { area.clone() };
            lay(&mut path, &turned);
            path.close();
        }
        if let Some(path) = path.finish() {
            self.pixels.fill_path(&path, &ink.paint(), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// Fills a rectangle with its upper left corner there.
    pub fn rectangle(&mut self, [x, y]: Pixel, [width, height]: [f64; 2], ink: Ink) {
        if let Some(area) = Rect::from_xywh(x as f32, y as f32, width as f32, height as f32) {
            self.pixels.fill_rect(area, &ink.paint(), Transform::identity(), None);
        }
    }

    /// Draws a line through places.
    pub fn line(&mut self, places: &[Pixel], line: &Line) {
        let mut path = PathBuilder::new();
        lay(&mut path, places);
        self.stroke(path, line);
    }

    /// Draws lines around areas.
    pub fn around(&mut self, areas: &[Vec<Pixel>], line: &Line) {
        let mut path = PathBuilder::new();
        for area in areas {
            lay(&mut path, area);
            path.close();
        }
        self.stroke(path, line);
    }

    fn stroke(&mut self, path: PathBuilder, line: &Line) {
        let dash = if line.is_dashed { StrokeDash::new(vec![6.0, 5.0], 0.0) } else { None };
        let stroke = Stroke {
            width: line.width as f32,
            line_cap: LineCap::Butt,
            line_join: LineJoin::Round,
            dash,
            ..Stroke::default()
        };
        if let Some(path) = path.finish() {
            self.pixels.stroke_path(&path, &line.ink.paint(), &stroke, Transform::identity(), None);
        }
    }

    /// Writes a line of text with its upper left corner there.
    pub fn text(&mut self, [x, y]: Pixel, line: &str, letters: Letters, ink: Ink) {
        let (weight, height) = letters.font();
        let step = get_raster_width(weight, height);
        for (i, character) in line.chars().enumerate() {
            let Some(glyph) = get_raster(character, weight, height) else { continue };
            for (row, values) in glyph.rows().enumerate() {
                for (column, &value) in values.iter().enumerate().filter(|(_, value)| **value > 0) {
                    let at = [x.round() as i64 + (i * step + column) as i64, y.round() as i64 + row as i64];
                    self.blend(at, ink, f64::from(value) / 255.0);
                }
            }
        }
    }

    fn blend(&mut self, [x, y]: [i64; 2], ink: Ink, part: f64) {
        let (width, height) = (i64::from(self.pixels.width()), i64::from(self.pixels.height()));
        if !(0..width).contains(&x) || !(0..height).contains(&y) {
            return;
        }
        if let Some(pixel) = self.pixels.pixels_mut().get_mut((y * width + x) as usize) {
            let part = part * ink.opacity;
            let mix = |old: u8, new: u8| (f64::from(old) * (1.0 - part) + f64::from(new) * part).round() as u8;
            let [r, g, b] = ink.rgb;
            let mixed = [mix(pixel.red(), r), mix(pixel.green(), g), mix(pixel.blue(), b)];
            if let Some(opaque) = PremultipliedColorU8::from_rgba(mixed[0], mixed[1], mixed[2], 255) {
                *pixel = opaque;
            }
        }
    }

    /// Writes a PNG, whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: &Path) -> anyhow::Result<()> {
        files::write_atomically(path, |writer| {
            write_png(writer, &self.pixels).with_context(|| format!("cannot write {}", path.display()))
        })
    }
}

/// Writes pixels as a PNG without transparency.
fn write_png(writer: impl Write, pixels: &Pixmap) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(writer, pixels.width(), pixels.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    let mut image = encoder.write_header()?;
    let rgb: Vec<u8> = pixels.pixels().iter().flat_map(|pixel| [pixel.red(), pixel.green(), pixel.blue()]).collect();
    image.write_image_data(&rgb)?;
    image.finish()
}

fn lay(path: &mut PathBuilder, places: &[Pixel]) {
    for (i, [x, y]) in places.iter().enumerate() {
        if i == 0 {
            path.move_to(*x as f32, *y as f32);
        } else {
            path.line_to(*x as f32, *y as f32);
        }
    }
}

fn signed_area(area: &[Pixel]) -> f64 {
    let next = area.iter().cycle().skip(1);
    area.iter().zip(next).map(|(a, b)| 0.5 * (a[0] * b[1] - a[1] * b[0])).sum()
}

/// Words that do not lie on each other.
#[derive(Debug, Default)]
pub struct Labels {
    /// Low and high corners, pixels.
    taken: Vec<[Pixel; 2]>,
}

impl Labels {
    /// Keeps words off a box.
    pub fn take(&mut self, low: Pixel, high: Pixel) {
        self.taken.push([low, high]);
    }

    /// Finds room for a line of text of this size: the first of the places at which its upper left corner may be, within a box.
    pub fn find(&mut self, size: [f64; 2], places: &[Pixel], within: [Pixel; 2]) -> Option<Pixel> {
        let free = |&&[x, y]: &&Pixel| {
            let (low, high) = ([x - 1.0, y - 1.0], [x + size[0] + 1.0, y + size[1] + 1.0]);
            let inside = (0..2).all(|i| low[i] >= within[0][i] && high[i] <= within[1][i]);
            let apart = |[l, h]: &[Pixel; 2]| (0..2).any(|i| high[i] <= l[i] || low[i] >= h[i]);
            inside && self.taken.iter().all(apart)
        };
        let &[x, y] = places.iter().find(free)?;
        self.take([x, y], [x + size[0], y + size[1]]);
        Some([x, y])
    }
}
