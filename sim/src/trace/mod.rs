//! Rays: which surface sees which. They tell topology and never phase: a hit names a body and a triangle, and whatever
//! becomes a length of a path is computed again in f64 from those names ([`World::point`], [`World::exact`]).
//!
//! A [`World`] is a list of [`Body`] structures: the static room and its furniture in one that is built slowly and well, each
//! moving body in one of its own that is refitted as it moves. They are kept apart because one structure over large walls
//! beside dense bodies is slow to build well and has to be built again for every pose.
//!
//! Triangles are met after Woop, Benthin and Wald, "Watertight ray/triangle intersection" (JCGT 2(1), 2013): seen along the
//! ray, both triangles of an edge compute the same number with opposite signs. Where f32 says zero, f64 decides exactly, and
//! where the ray goes through an edge or a vertex itself, it is taken to pass an infinitesimal step beside it. So no ray slips
//! through an edge and none meets it twice, and what is hit depends neither on the shape of the structure nor on the
//! processor: nearest first, then the lowest (body, triangle).

mod body;
mod packet;
mod probe;
mod ray;
pub mod reference;
mod triangle;
mod world;

pub use body::{Body, BodyError, Build};
pub use ray::{Crossings, Hit, Ray, Surface};
pub use world::World;

#[cfg(test)]
mod hard_cases;
