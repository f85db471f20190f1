//! The normals around a place on a mesh as smooth functions of it, by least squares.

use glam::{DVec2, DVec3};

/// Terms of a cubic in two variables; the first three are a plane's, the first six a quadratic's.
const TERMS: usize = 10;
/// Fewer vertices than this hold no cubic, or no quadratic.
const FOR_CUBIC: usize = 14;
const FOR_QUADRATIC: usize = 9;

/// `1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3`.
fn cubic(x: f64, y: f64) -> [f64; TERMS] {
    let (xx, yy) = (x * x, y * y);
    [1.0, x, y, xx, x * y, yy, x * xx, xx * y, x * yy, y * yy]
}

/// The normals around a point as cubic functions of the place, `n . u` and `n . v`, with x and y in units of the radius.
/// Normals rather than heights: on a sphere, and nearly so on any round body, they are linear however far one goes.
pub(super) struct GaussMap {
    pub(super) centre: DVec3,
    pub(super) normal: DVec3,
    pub(super) u: DVec3,
    pub(super) v: DVec3,
    pub(super) radius_m: f64,
    pub(super) along_u: [f64; TERMS],
    pub(super) along_v: [f64; TERMS],
}

impl GaussMap {
    /// Tangential components of the normal at a place (in radii).
    pub(super) fn tilt(&self, at: DVec2) -> DVec2 {
        let row = cubic(at.x, at.y);
        let value = |c: &[f64; TERMS]| c.iter().zip(row).map(|(c, r)| c * r).sum();
        DVec2::new(value(&self.along_u), value(&self.along_v))
    }

    /// The shape operator at a place, made symmetric: uu, uv, vv, 1/m.
    pub(super) fn curvature(&self, at: DVec2) -> [f64; 3] {
        let DVec2 { x, y } = at;
        let by_x = |c: &[f64; TERMS]| {
            c[1] + 2.0 * c[3] * x + c[4] * y + 3.0 * c[6] * x * x + 2.0 * c[7] * x * y + c[8] * y * y
        };
        let by_y = |c: &[f64; TERMS]| {
            c[2] + c[4] * x + 2.0 * c[5] * y + c[7] * x * x + 2.0 * c[8] * x * y + 3.0 * c[9] * y * y
        };
        let (a, b) = (&self.along_u, &self.along_v);
        [by_x(a), 0.5 * (by_y(a) + by_x(b)), by_y(b)].map(|w| w / self.radius_m)
    }

    /// The surface's point at a place: the normals' slopes, summed up from the centre.
    pub(super) fn point(&self, at: DVec2) -> DVec3 {
        let start = DVec2::new(self.along_u[0], self.along_v[0]);
        let depth = at.dot(0.5 * (self.tilt(at) + start));
        self.centre + self.radius_m * (self.u * at.x + self.v * at.y - self.normal * depth)
    }
}

/// Sums of a weighted least-squares fit of two functions by cubics.
pub(super) struct FitSums {
    pub(super) centre: DVec3,
    /// Normal, u and v.
    pub(super) frame: [DVec3; 3],
    pub(super) radius_m: f64,
    pub(super) matrix: [[f64; TERMS]; TERMS],
    pub(super) right: [[f64; 2]; TERMS],
    /// Sum of the squares that are fitted.
    pub(super) squares: f64,
    pub(super) count: usize,
}

impl FitSums {
    pub(super) fn new(centre: DVec3, frame: [DVec3; 3], radius_m: f64) -> Self {
        FitSums {
            centre,
            frame,
            radius_m,
            matrix: [[0.0; TERMS]; TERMS],
            right: [[0.0; 2]; TERMS],
            squares: 0.0,
            count: 0,
        }
    }

    pub(super) fn add(&mut self, x: f64, y: f64, weight: f64, u: f64, v: f64) {
        let row = cubic(x, y);
        for i in 0..TERMS {
            for j in 0..=i {
                self.matrix[i][j] += weight * row[i] * row[j];
            }
            self.right[i][0] += weight * row[i] * u;
            self.right[i][1] += weight * row[i] * v;
        }
        self.squares += weight * (u * u + v * v);
        self.count += 1;
    }

    /// Terms to try, the best first: more of them only where they explain so much more that it cannot be noise.
    pub(super) fn sizes(&self) -> &'static [usize] {
        let variance = |size: usize| {
            let Some(fit) = self.solve(size) else { return f64::INFINITY };
            let explained: f64 =
                (0..size).map(|i| fit.along_u[i] * self.right[i][0] + fit.along_v[i] * self.right[i][1]).sum();
            (self.squares - explained).max(0.0) / (self.count as f64 - 0.8 * size as f64).max(0.5)
        };
        let (plane, quadratic, cubic) = (variance(3), variance(6), variance(10));
        // What is left may be rounding where a surface is its own fit, as a sphere is.
        let rounding = 1e-14 * self.squares;
        if cubic < 0.6 * quadratic.min(plane) + rounding {
            &[10, 6, 3]
        } else if quadratic < 0.6 * plane + rounding {
            &[6, 3, 10]
        } else {
            &[3, 6, 10]
        }
    }

    /// A cubic (10 terms), a quadratic (6) or a plane (3), if the points are enough for it.
    pub(super) fn solve(&self, size: usize) -> Option<GaussMap> {
        let enough = match size {
            10 => FOR_CUBIC,
            6 => FOR_QUADRATIC,
            _ => 3,
        };
        if self.count < enough {
            return None;
        }
        let (along_u, along_v) = self.cholesky(size)?;
        let [normal, u, v] = self.frame;
        Some(GaussMap { centre: self.centre, normal, u, v, radius_m: self.radius_m, along_u, along_v })
    }

    fn cholesky(&self, size: usize) -> Option<([f64; TERMS], [f64; TERMS])> {
        let mut l = [[0.0; TERMS]; TERMS];
        for i in 0..size {
            for j in 0..=i {
                let dot: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
                let rest = self.matrix[i][j] - dot;
                if i == j {
                    // Points on a line or a conic section: no unique answer.
                    if rest <= 1e-9 * self.matrix[i][i] {
                        return None;
                    }
                    l[i][i] = rest.sqrt();
                } else {
                    l[i][j] = rest / l[j][j];
                }
            }
        }
        let solve = |column: usize| {
            let mut x = [0.0; TERMS];
            for i in 0..size {
                let dot: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
                x[i] = (self.right[i][column] - dot) / l[i][i];
            }
            for i in (0..size).rev() {
                let dot: f64 = (i + 1..size).map(|k| l[k][i] * x[k]).sum();
                x[i] = (x[i] - dot) / l[i][i];
            }
            x
        };
        Some((solve(0), solve(1)))
    }
}
