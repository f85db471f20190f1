//! The quantum layer.

use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray2, PyArray3, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use radome_models::quantum::{self, CircuitSpec, Draw};

use crate::error::{Outcome, detached, from_python, to_exception, to_python};

/// Expectations, their derivatives by inputs, and by angles.
type Jacobian<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray3<f64>>, Bound<'py, PyArray3<f64>>);

/// Circuit that encodes one input a qubit, turns the qubits by trained angles and measures Z on each.
#[pyclass(frozen, module = "radome._radome")]
pub struct Circuit {
    inner: quantum::Circuit,
}

/// Rows of inputs: copies, which no other thread changes.
fn rows(x: &PyReadonlyArray2<'_, f64>) -> Vec<Vec<f64>> {
    x.as_array().rows().into_iter().map(|row| row.to_vec()).collect()
}

fn draw(call: u64, row: usize) -> Draw {
    Draw { call, row: row as u64 }
}

#[pymethods]
impl Circuit {
    #[new]
    fn new(py: Python<'_>, settings: &Bound<'_, PyAny>) -> PyResult<Self> {
        let spec: CircuitSpec = from_python("circuit", settings)?;
        let inner = quantum::Circuit::new(&spec).map_err(|error| to_exception(py, &error))?;
        Ok(Circuit { inner })
    }

    /// Settings, a dict.
    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, self.inner.spec())
    }

    /// Number of inputs and of outputs.
    #[getter]
    fn qubits(&self) -> usize {
        self.inner.qubits()
    }

    /// Number of trained angles.
    #[getter]
    fn angle_count(&self) -> usize {
        self.inner.angle_count()
    }

    /// Names of the outputs, such as `["ZI", "IZ"]`.
    #[getter]
    fn observables(&self) -> Vec<String> {
        self.inner.spec().observables()
    }

    /// Expectations, `[row][observable]`, float64, of inputs `x`, `[row][qubit]`, and angles `theta`, `[angle]`, both rad.
    #[pyo3(signature = (x, theta, call=0))]
    fn expectations<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
        theta: PyReadonlyArray1<'py, f64>,
        call: u64,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (x, theta) = (rows(&x), theta.as_array().to_vec());
        let values = detached(py, || -> Outcome<Array2<f64>> {
            let mut values = Vec::new();
            for (row, x) in x.iter().enumerate() {
                values.extend(self.inner.expectations(x, &theta, draw(call, row))?);
            }
            Ok(Array2::from_shape_vec((x.len(), self.inner.qubits()), values)?)
        })?;
        Ok(values.into_pyarray(py))
    }

    /// Expectations as above, and their derivatives by `x`, `[row][observable][qubit]`, and by `theta`,
    /// `[row][observable][angle]`, 1/rad.
    #[pyo3(signature = (x, theta, call=0))]
    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
        theta: PyReadonlyArray1<'py, f64>,
        call: u64,
    ) -> PyResult<Jacobian<'py>> {
        let (x, theta) = (rows(&x), theta.as_array().to_vec());
        let (values, by_x, by_theta) = detached(py, || {
            let (mut values, mut by_x, mut by_theta) = (Vec::new(), Vec::new(), Vec::new());
            for (row, x) in x.iter().enumerate() {
                let jacobian = self.inner.jacobian(x, &theta, draw(call, row))?;
                values.extend(jacobian.expectations);
                by_x.extend(jacobian.by_x.into_iter().flatten());
                by_theta.extend(jacobian.by_theta.into_iter().flatten());
            }
            let (rows, qubits, angles) = (x.len(), self.inner.qubits(), self.inner.angle_count());
            Ok((
                Array2::from_shape_vec((rows, qubits), values)?,
                Array3::from_shape_vec((rows, qubits, qubits), by_x)?,
                Array3::from_shape_vec((rows, qubits, angles), by_theta)?,
            ))
        })?;
        Ok((values.into_pyarray(py), by_x.into_pyarray(py), by_theta.into_pyarray(py)))
    }
}
