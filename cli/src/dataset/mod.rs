//! Datasets: builds labelled maps from a spec, on one machine or many.
//!
//! A spec ([`spec`]) is planned into units: runs of a scene, and recordings ([`plan`]). Each unit becomes a small
//! dataset of its own ([`mod@unit`]), complete or absent. The units are merged in the order of the plan ([`mod@build`],
//! [`merge`]). The resulting bytes depend neither on the number of processes that made the units nor on interruptions.

pub mod build;
pub mod detector;
pub mod features;
mod fingerprints;
mod folders;
pub mod merge;
pub mod pairing;
pub mod plan;
pub mod rung;
pub mod spec;
pub mod thermal;
mod unit;
