//! Datasets.

use std::path::PathBuf;
use std::sync::Mutex;

use numpy::ndarray::Array3;
use numpy::{IntoPyArray, PyArray1, PyArray3};
use pyo3::prelude::*;
use radome_dsp::RdmSpec;
use radome_models::dataset::{self, DatasetHeader, ManifestRow, Split, SplitSpec};

use crate::error::{detached, from_python, lock, text_to_exception, to_exception, to_python};
use crate::map::{Map, spec};
use crate::waveform::Waveform;

/// Dataset folder, checked when it is opened.
#[pyclass(frozen, module = "radome._radome")]
pub struct Dataset {
    /// The dataset.
    pub inner: dataset::Dataset,
}

#[pymethods]
impl Dataset {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let inner = detached(py, || Ok(dataset::Dataset::open(&path)?))?;
        Ok(Dataset { inner })
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    /// Properties that all maps share, a dict.
    #[getter]
    fn header<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, self.inner.header())
    }

    /// Waveform of the frames.
    #[getter]
    fn waveform(&self) -> Waveform {
        Waveform(self.inner.header().waveform.clone().into())
    }

    /// A dict for each map.
    fn rows<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.inner.rows())
    }

    /// Class of each map: 0 empty, 1 one, 2 two; `[map]`, int64.
    fn labels<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        let labels: Vec<i64> = self.inner.rows().iter().map(|row| row.label.index() as i64).collect();
        labels.into_pyarray(py)
    }

    /// Split of each map, 0 train, 1 validation, 2 test, by the keys of a split's rule.
    fn splits<'py>(&self, py: Python<'py>, spec: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let spec: SplitSpec = from_python("split", spec)?;
        let splits = detached(py, || Ok(self.inner.splits(&spec)?))?;
        let number = |split: &Split| match split {
            Split::Train => 0,
            Split::Validation => 1,
            Split::Test => 2,
        };
        Ok(splits.iter().map(number).collect::<Vec<i64>>().into_pyarray(py))
    }

    /// Cells of a map in dB, `[rx][doppler][range]`, float32, compared with its hash.
    fn verified_map<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let cells = detached(py, || Ok(self.inner.map(index)?))?;
        let shape = self.inner.header().shape;
        let cells = Array3::from_shape_vec((shape.rx, shape.doppler, shape.range), cells);
        Ok(cells.map_err(|error| to_exception(py, &error))?.into_pyarray(py))
    }

    /// SHA-256 over header and manifest, hex.
    fn hash(&self, py: Python<'_>) -> String {
        py.detach(|| self.inner.hash())
    }
}

/// Writer of a dataset folder.
#[pyclass(frozen, module = "radome._radome")]
pub struct DatasetWriter {
    writer: Mutex<Option<dataset::DatasetWriter>>,
    map_spec: RdmSpec,
}

#[pymethods]
impl DatasetWriter {
    #[new]
    #[pyo3(signature = (path, waveform, map_spec=None))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        waveform: &Bound<'_, Waveform>,
        map_spec: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let waveform = &waveform.get().0;
        let map_spec = spec(map_spec, waveform)?;
        let writer = detached(py, || {
            let header = DatasetHeader::new(radome_dsp::Waveform::clone(waveform), map_spec)?;
            Ok(dataset::DatasetWriter::create(&path, &header)?)
        })?;
        Ok(DatasetWriter { writer: Mutex::new(Some(writer)), map_spec })
    }

    /// Adds a map; `row` is a dict with the keys of a manifest's row.
    fn add(&self, py: Python<'_>, map: &Bound<'_, Map>, row: &Bound<'_, PyAny>) -> PyResult<()> {
        let row: ManifestRow = from_python("row", row)?;
        let Map { inner: map, spec, .. } = map.get();
        if *spec != self.map_spec {
            let text = "the map was made by another map spec than the dataset's\n\nhint: make maps with the dataset's map_spec";
            return Err(text_to_exception(py, text.to_owned()));
        }
        detached(py, || match lock(&self.writer).as_mut() {
            Some(writer) => Ok(writer.push(map, row)?),
            None => Err("the dataset is finished".into()),
        })
    }

    /// Gives the folder its name.
    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        detached(py, || match lock(&self.writer).take() {
            Some(writer) => Ok(writer.finish()?),
            None => Ok(()),
        })
    }

    /// Removes what has been written, unless the dataset is finished.
    fn discard(&self, py: Python<'_>) {
        py.detach(|| drop(lock(&self.writer).take()));
    }
}
