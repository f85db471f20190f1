//! Rays: which surface sees which. They tell topology and never phase: a hit names a triangle, and whatever becomes a length of
//! a path is computed again in f64 from the plane of that triangle.
//!
//! Triangles are met after Woop, Benthin and Wald, "Watertight ray/triangle intersection" (JCGT 2(1), 2013): seen along the
//! ray, both triangles of an edge compute the same number with opposite signs. Where f32 says zero, f64 decides exactly, and
//! where the ray goes through an edge or a vertex itself, it is taken to pass an infinitesimal step beside it. So no ray slips
//! through an edge and none meets it twice, and what is hit depends neither on the shape of the structure nor on the
//! processor: nearest first, then the lowest triangle.

mod probe;
mod ray;
mod triangle;
mod world;

pub use ray::{Hit, Ray};
pub use world::{World, WorldError};

#[cfg(test)]
mod hard_cases;
#[cfg(test)]
mod reference;
