//! Operations on the vector of one lane in double precision, for the bodies of loops over lanes. Vectors are plain
//! arrays, and every function is inlined.

use super::WideRow3;

/// A vector of three components.
pub type Vector = [f64; 3];

/// Dot product.
#[inline(always)]
pub fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Sum.
#[inline(always)]
pub fn add(a: Vector, b: Vector) -> Vector {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Difference.
#[inline(always)]
pub fn subtract(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Product with a scalar.
#[inline(always)]
pub fn scale(a: Vector, factor: f64) -> Vector {
    [a[0] * factor, a[1] * factor, a[2] * factor]
}

/// Product component by component.
#[inline(always)]
pub fn times(a: Vector, b: Vector) -> Vector {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

/// Quotient component by component.
#[inline(always)]
pub fn over(a: Vector, b: Vector) -> Vector {
    [a[0] / b[0], a[1] / b[1], a[2] / b[2]]
}

/// The vector divided by its length; NaN for a zero vector.
#[inline(always)]
pub fn normalized(a: Vector) -> Vector {
    scale(a, 1.0 / dot(a, a).sqrt())
}

/// Selects `a` where the condition holds, `b` elsewhere.
#[inline(always)]
pub fn choose(condition: bool, a: Vector, b: Vector) -> Vector {
    [if condition { a[0] } else { b[0] }, if condition { a[1] } else { b[1] }, if condition { a[2] } else { b[2] }]
}

/// Writes the vector of one lane.
#[inline(always)]
pub fn store(rows: &mut WideRow3, l: usize, vector: Vector) {
    rows[0][l] = vector[0];
    rows[1][l] = vector[1];
    rows[2][l] = vector[2];
}

/// Cross product.
#[inline(always)]
pub fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Unit vector perpendicular to a unit vector (Duff and others, Building an Orthonormal Basis, Revisited, JCGT 6,
/// 2017).
#[inline(always)]
pub fn tangent(normal: Vector) -> Vector {
    let sign = 1f64.copysign(normal[2]);
    let a = -1.0 / (sign + normal[2]);
    [normal[0] * normal[1] * a, sign + normal[1] * normal[1] * a, -normal[1]]
}
