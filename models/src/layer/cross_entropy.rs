//! Class-weighted cross-entropy of logits.

use candle_core::{Result, Shape, Tensor};

use super::operation::{Argument, Gradients, Operation, apply};

const NAME: &str = "cross_entropy";

/// `sum_i w_i (log sum_k exp z_ik - z_i,label) / sum_i w_i` with `w_i` the weight of sample i's class: a scalar.
///
/// `logits` is `[batch][class]`. If all weights of a batch are zero, the loss is zero.
///
/// # Errors
/// `logits` has another shape, there is not one label for each row and one weight for each class, a label is no class, or the
/// tensor is not f32 on the CPU.
pub fn cross_entropy(logits: &Tensor, labels: &[usize], class_weights: &[f32]) -> Result<Tensor> {
    let &[batch, classes] = logits.dims() else {
        candle_core::bail!("{NAME}: expected logits [batch, class], got {:?}", logits.dims());
    };
    if batch != labels.len() || classes != class_weights.len() || labels.iter().any(|&l| l >= classes) {
        candle_core::bail!(
            "{NAME}: logits {:?} need {batch} labels below {classes} and {classes} weights, got {} labels, {} weights",
            logits.dims(),
            labels.len(),
            class_weights.len()
        );
    }
    apply(NAME, &[logits], CrossEntropy { labels: labels.to_vec(), class_weights: class_weights.to_vec() })
}

/// Softmax of one row of logits, in f64. The maximum is subtracted first, so that nothing overflows.
pub(crate) fn softmax(logits: &[f32], temperature: f64) -> Vec<f64> {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let exponentials: Vec<f64> = logits.iter().map(|&z| (f64::from(z - largest) / temperature).exp()).collect();
    let sum: f64 = exponentials.iter().sum();
    exponentials.iter().map(|e| e / sum).collect()
}

struct CrossEntropy {
    labels: Vec<usize>,
    class_weights: Vec<f32>,
}

impl CrossEntropy {
    fn weight(&self, label: usize) -> f64 {
        self.class_weights.get(label).copied().map_or(0.0, f64::from)
    }

    fn total_weight(&self) -> f64 {
        let total: f64 = self.labels.iter().map(|&l| self.weight(l)).sum();
        if total > 0.0 { total } else { 1.0 }
    }
}

impl Operation for CrossEntropy {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [Argument { values: logits, .. }] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let mut loss = 0.0f64;
        for (row, &label) in logits.chunks_exact(self.class_weights.len()).zip(&self.labels) {
            let largest = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let log_sum = row.iter().map(|&z| f64::from(z - largest).exp()).sum::<f64>().ln() + f64::from(largest);
            loss += self.weight(label) * (log_sum - f64::from(row[label]));
        }
        Ok((vec![(loss / self.total_weight()) as f32], Shape::from(())))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [Argument { values: logits, .. }] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let scale = gradient.iter().copied().map(f64::from).sum::<f64>() / self.total_weight();
        let mut out = Vec::with_capacity(logits.len());
        for (row, &label) in logits.chunks_exact(self.class_weights.len()).zip(&self.labels) {
            for (class, p) in softmax(row, 1.0).into_iter().enumerate() {
                let target = if class == label { 1.0 } else { 0.0 };
                out.push((scale * self.weight(label) * (p - target)) as f32);
            }
        }
        Ok(vec![Some(out)])
    }
}
