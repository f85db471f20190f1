//! Values of candle tensors as slices.

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, Error, Layout, Result, Storage, Tensor};

/// The f32 values of a contiguous CPU tensor. Errors name the layer.
pub(super) fn values<'a>(layer: &'static str, storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let CpuStorage::F32(data) = storage else {
        return Err(Error::UnsupportedDTypeForOp(storage.dtype(), layer).bt());
    };
    let Some((start, end)) = layout.contiguous_offsets() else {
        return Err(Error::RequiresContiguous { op: layer }.bt());
    };
    data.get(start..end).ok_or_else(|| Error::Msg(format!("{layer}: layout {start}..{end} exceeds storage")).bt())
}

/// Runs `f` on the f32 values of a tensor, made contiguous first if need be.
pub(crate) fn with_values<R>(layer: &'static str, tensor: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(cpu) => f(values(layer, cpu, layout)?),
        _ => candle_core::bail!("{layer}: tensor is not on the CPU"),
    }
}
