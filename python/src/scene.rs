//! Paths and people of a scene.

use std::path::PathBuf;

use pyo3::prelude::*;
use radome_sim::path_list::{PathList, PathListOptions};
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde::Deserialize;

use crate::error::{detached, from_python, to_python};
use crate::fork;

/// Options of a path list, as `radome.paths` passes them.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Options {
    time_s: f64,
    seed: u64,
    people: Option<usize>,
    person: Option<usize>,
    margin_db: f64,
}

/// Every path of a scene at one time, a dict. `options` is a dict with the keys of `radome.paths`.
#[pyfunction]
pub fn paths<'py>(py: Python<'py>, scene: PathBuf, options: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let Options { time_s, seed, people, person, margin_db } = from_python("paths", options)?;
    let list = detached(py, || {
        fork::check_pools("the simulator")?;
        if !(0.0..=PathListOptions::LATEST_S).contains(&time_s) {
            return Err(
                format!("time_s is {time_s}, not within a day\n\nhint: give seconds from the first frame on").into()
            );
        }
        let scene = Scene::load(&scene)?;
        Simulator::check_people(&scene, people)?;
        let options = PathListOptions { seed, people, person, time_s, margin_db };
        Ok(PathList::new(&scene, &options)?)
    })?;
    to_python(py, &list)
}

/// Options of a list of people, as `radome.people` passes them.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PeopleOptions {
    frames: u64,
    seed: u64,
    people: Option<usize>,
}

/// Where the people of a scene are in each frame, a list of dicts. `options` is a dict with the keys of `radome.people`.
#[pyfunction]
pub fn people<'py>(py: Python<'py>, scene: PathBuf, options: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let PeopleOptions { frames, seed, people } = from_python("people", options)?;
    let listed = detached(py, || {
        fork::check_pools("the simulator")?;
        let scene = Scene::load(&scene)?;
        Simulator::check_people(&scene, people)?;
        let options = SimulateOptions { seed, people, frames: Some(frames), ..SimulateOptions::default() };
        let simulator = Simulator::new(&scene, options)?;
        Ok((0..frames).flat_map(|frame| simulator.listed_people(frame)).collect::<Vec<_>>())
    })?;
    to_python(py, &listed)
}
