//! Compiled part of the Python package `radome`.
//!
//! Classes and functions here take and return what NumPy and the module `json` know. The package in `radome/` adds defaults,
//! documentation and types. Rules that all of it keeps:
//! - Work of more than some microseconds runs without the interpreter's lock ([`error::detached`]). A mutex is only ever locked
//!   without it, so that two threads on one object wait for each other and not for the lock.
//! - Every error is an exception of `radome._errors` with hint and causes ([`error::to_exception`]).
//! - Arrays of frames and maps are views that keep their owner alive ([`frame::read_only`]).

use pyo3::prelude::*;

mod adapter;
mod circuit;
mod dataset;
mod error;
mod fork;
mod frame;
mod map;
mod model;
mod opened;
mod recorder;
mod scene;
mod source;
mod train;
mod waveform;

/// Compiled part of the package `radome`.
#[pymodule]
fn _radome(module: &Bound<'_, PyModule>) -> PyResult<()> {
    fork::remember_process();
    module.add_class::<adapter::Adapter>()?;
    module.add_class::<circuit::Circuit>()?;
    module.add_class::<dataset::Dataset>()?;
    module.add_class::<dataset::DatasetWriter>()?;
    module.add_class::<frame::Frame>()?;
    module.add_class::<map::Map>()?;
    module.add_class::<map::MapProcessor>()?;
    module.add_class::<model::Filter>()?;
    module.add_class::<model::Model>()?;
    module.add_class::<recorder::Recorder>()?;
    module.add_class::<source::Source>()?;
    module.add_class::<waveform::Waveform>()?;
    module.add_function(wrap_pyfunction!(map::rdm, module)?)?;
    module.add_function(wrap_pyfunction!(opened::boards, module)?)?;
    module.add_function(wrap_pyfunction!(recorder::read_labels, module)?)?;
    module.add_function(wrap_pyfunction!(scene::paths, module)?)?;
    module.add_function(wrap_pyfunction!(scene::people, module)?)?;
    module.add_function(wrap_pyfunction!(train::networks, module)?)?;
    module.add_function(wrap_pyfunction!(train::train, module)?)?;
    Ok(())
}
