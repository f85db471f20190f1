//! Datasets: from a spec to labelled maps, on one machine or many.
//!
//! A spec ([`spec`]) is planned into units, runs of a scene and recordings ([`plan`]); each unit becomes a small dataset of
//! its own ([`unit`]), whole or absent; together they are merged in the order of the plan ([`mod@build`], [`merge`]). So the
//! bytes that come out depend neither on how many processes made the units nor on how often one was killed.

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
