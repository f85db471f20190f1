//! What a layer is to the graph of gradients: a function of one to three arrays with a hand-written gradient.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Storage, Tensor};

use super::{values, with_values};

/// One input of a layer: its values in row-major order and its shape.
#[derive(Clone, Copy)]
pub(super) struct Argument<'a> {
    pub values: &'a [f32],
    pub dims: &'a [usize],
}

/// Gradients of a layer's inputs, in their order; `None` where nobody needs one.
pub(super) type Gradients = Vec<Option<Vec<f32>>>;

/// A layer of one to three inputs and one output.
pub(super) trait Operation: Send + Sync + 'static {
    /// Name in errors.
    fn name(&self) -> &'static str;

    /// Checks the shapes and computes the output.
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)>;

    /// `gradient` belongs to `output`; it is handed over, so that it can become an input's gradient in place.
    fn backward(&self, inputs: &[Argument<'_>], output: &[f32], gradient: Vec<f32>) -> Result<Gradients>;
}

/// Applies `operation` to tensors as one node of candle's graph.
pub(super) fn apply(inputs: &[&Tensor], operation: impl Operation) -> Result<Tensor> {
    match *inputs {
        [a] => a.apply_op1(Node(operation)),
        [a, b] => a.apply_op2(b, Node(operation)),
        [a, b, c] => a.apply_op3(b, c, Node(operation)),
        _ => candle_core::bail!("{}: {} inputs", operation.name(), inputs.len()),
    }
}

struct Node<O>(O);

impl<O: Operation> Node<O> {
    fn run(&self, inputs: &[(&CpuStorage, &Layout)]) -> Result<(CpuStorage, Shape)> {
        let arguments = inputs
            .iter()
            .map(|(storage, layout)| {
                Ok(Argument { values: values(self.0.name(), storage, layout)?, dims: layout.dims() })
            })
            .collect::<Result<Vec<_>>>()?;
        let (output, shape) = self.0.forward(&arguments)?;
        Ok((CpuStorage::F32(output), shape))
    }

    fn gradients(&self, inputs: &[&Tensor], output: &Tensor, gradient: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let name = self.0.name();
        let gradient = with_values(name, gradient, |g| Ok(g.to_vec()))?;
        let contiguous = inputs.iter().map(|t| t.contiguous()).collect::<Result<Vec<_>>>()?;
        let locked: Vec<_> = contiguous.iter().map(|t| t.storage_and_layout()).collect();
        let arguments = locked
            .iter()
            .map(|(storage, layout)| match &**storage {
                Storage::Cpu(cpu) => Ok(Argument { values: values(name, cpu, layout)?, dims: layout.dims() }),
                _ => candle_core::bail!("{name}: a tensor is not on the CPU"),
            })
            .collect::<Result<Vec<_>>>()?;
        let gradients = with_values(name, output, |output| self.0.backward(&arguments, output, gradient))?;
        inputs
            .iter()
            .zip(gradients)
            .map(|(input, g)| g.map(|g| Tensor::from_vec(g, input.shape(), input.device())).transpose())
            .collect()
    }
}

impl<O: Operation> CustomOp1 for Node<O> {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn cpu_fwd(&self, a: &CpuStorage, la: &Layout) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la)])
    }

    fn bwd(&self, a: &Tensor, output: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        Ok(self.gradients(&[a], output, gradient)?.pop().flatten())
    }
}

impl<O: Operation> CustomOp2 for Node<O> {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn cpu_fwd(&self, a: &CpuStorage, la: &Layout, b: &CpuStorage, lb: &Layout) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la), (b, lb)])
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        output: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let mut gradients = self.gradients(&[a, b], output, gradient)?.into_iter();
        Ok((gradients.next().flatten(), gradients.next().flatten()))
    }
}

impl<O: Operation> CustomOp3 for Node<O> {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        la: &Layout,
        b: &CpuStorage,
        lb: &Layout,
        c: &CpuStorage,
        lc: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la), (b, lb), (c, lc)])
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        c: &Tensor,
        output: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let mut gradients = self.gradients(&[a, b, c], output, gradient)?.into_iter();
        Ok((gradients.next().flatten(), gradients.next().flatten(), gradients.next().flatten()))
    }
}
