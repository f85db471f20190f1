//! Layout of maps in shards and in the input of a network.

use radome_dsp::RdmShape;

/// Maps in one shard.
pub(super) const MAPS_PER_SHARD: usize = 256;

/// File name of a shard.
pub(super) fn shard_name(shard: usize) -> String {
    format!("maps-{shard:05}.npy")
}

/// One channel of a map as input of a network: `[doppler][range]` of channel `rx` transposed to `[range][doppler]`.
///
/// `None` if the number of cells does not match the shape, or if there is no such channel.
pub fn network_input(db: &[f32], shape: RdmShape, rx: usize) -> Option<Vec<f32>> {
    if db.len() != shape.cells() || rx >= shape.rx {
        return None;
    }
    let plane = db.get(rx * shape.doppler * shape.range..(rx + 1) * shape.doppler * shape.range)?;
    let mut out = Vec::with_capacity(plane.len());
    for range in 0..shape.range {
        out.extend(plane.iter().skip(range).step_by(shape.range.max(1)));
    }
    Some(out)
}
