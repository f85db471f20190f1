//! Check of stored recordings of simulations before a later run reuses them.

use std::ops::Range;
use std::path::Path;

use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, SourceEvent};
use radome_sim::Simulator;

/// Returns whether a file is the recording of exactly these frames of a simulation. It compares the first and last frame number,
/// the waveform, and the content of the `compared` frames. A change of the scene or the simulator changes that content.
pub fn is_recording_of(path: &Path, simulator: &Simulator, frames: Range<u64>, compared: &[u64]) -> bool {
    let Ok(mut recording) = Recording::open(path) else { return false };
    let Ok(extent) = recording.extent() else { return false };
    let numbers = extent.map(|extent| extent.first.sequence..extent.last.sequence.saturating_add(1));
    let expected = Some(frames).filter(|frames| !frames.is_empty());
    if numbers != expected || recording.waveform() != simulator.waveform() {
        return false;
    }
    compared.iter().all(|&index| {
        let mut stored = Frame::zeroed(recording.waveform().shape());
        let is_readable = recording.seek_frame(index).is_ok()
            && matches!(recording.next_frame(&mut stored), Ok(SourceEvent::Frame))
            && stored.sequence == index;
        is_readable && {
            let simulated = simulator.frame(index);
            (stored.time_ns, stored.shape, stored.truth) == (simulated.time_ns, simulated.shape, simulated.truth)
                && stored.codes == simulated.codes
        }
    })
}
