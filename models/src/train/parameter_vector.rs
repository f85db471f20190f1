//! Parameters of some layers of a network as one vector.

use candle_core::backprop::GradStore;
use candle_core::{Device, Result, Tensor};

use crate::network::Parameter;

/// Parameters of a network, in a fixed order.
pub(super) struct ParameterVector<'a> {
    parameters: Vec<&'a Parameter>,
}

impl<'a> ParameterVector<'a> {
    /// A vector of these parameters, one after the other.
    pub(super) fn new(parameters: Vec<&'a Parameter>) -> Self {
        ParameterVector { parameters }
    }

    /// The parameters.
    pub(super) fn iter(&self) -> impl Iterator<Item = &'a Parameter> {
        self.parameters.iter().copied()
    }

    /// Position of a parameter in the vector.
    pub(super) fn offset(&self, name: &str) -> Option<usize> {
        let index = self.parameters.iter().position(|parameter| parameter.name == name)?;
        Some(self.parameters[..index].iter().map(|parameter| parameter.variable.elem_count()).sum())
    }

    /// Vector of numbers that are the same for all elements of a parameter.
    pub(super) fn by_parameter(&self, number: impl Fn(&Parameter) -> f64) -> Vec<f64> {
        self.iter().flat_map(|parameter| vec![number(parameter); parameter.variable.elem_count()]).collect()
    }

    pub(super) fn numbers(&self) -> Result<Vec<f64>> {
        let mut numbers = Vec::new();
        for parameter in self.iter() {
            numbers.extend(parameter.variable.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from));
        }
        Ok(numbers)
    }

    pub(super) fn set(&self, numbers: &[f64]) -> Result<()> {
        let mut rest = numbers.iter();
        for Parameter { variable, .. } in self.iter() {
            let values: Vec<f32> = rest.by_ref().take(variable.elem_count()).map(|&v| v as f32).collect();
            variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// Gradient by the vector; 0 for parameters without a gradient.
    pub(super) fn gradient(&self, gradients: &GradStore) -> Result<Vec<f64>> {
        let mut gradient = Vec::new();
        for Parameter { variable, .. } in self.iter() {
            match gradients.get(variable) {
                Some(found) => gradient.extend(found.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from)),
                None => gradient.extend(vec![0.0; variable.elem_count()]),
            }
        }
        Ok(gradient)
    }
}
