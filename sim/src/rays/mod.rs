//! Ray tracing: finds which surfaces see each other. Rays give topology and never phase: a hit names a triangle, and
//! path lengths are recomputed in f64 from the plane of that triangle.
//!
//! The ray-triangle test follows Woop, Benthin and Wald, "Watertight ray/triangle intersection" (JCGT 2(1), 2013). Seen
//! along the ray, both triangles of an edge compute the same number with opposite signs. Where f32 gives zero, the test
//! is repeated exactly in f64. A ray through an edge or a vertex itself is treated as passing an infinitesimal step
//! beside it. Therefore no ray slips through an edge, and none hits both of its triangles. The hit is the nearest
//! triangle, and of several at the same distance the one of lowest index. It depends neither on the acceleration
//! structure nor on the processor.

mod probe;
mod ray;
mod tracer;
mod triangle;

pub use ray::{Hit, Ray};
pub use tracer::{RayTracer, RayTracerError};

#[cfg(test)]
mod hard_cases;
#[cfg(test)]
mod reference;
