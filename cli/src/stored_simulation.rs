//! Stored recordings of simulations, for reuse by later runs.

use std::ops::Range;
use std::path::Path;

use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, SourceEvent};
use radome_sim::Simulator;

/// Returns whether a file is the recording of exactly these frames of a simulation. It compares the frame numbers and
/// the content of the `looked_at` frames, where any change of a scene or the simulator shows.
pub fn is_recording_of(path: &Path, simulator: &Simulator, frames: Range<u64>, looked_at: &[u64]) -> bool {
    let Ok(mut recording) = Recording::open(path) else { return false };
    let Ok(extent) = recording.extent() else { return false };
    let numbers = extent.map(|extent| extent.first.sequence..extent.last.sequence.saturating_add(1));
    let expected = Some(frames).filter(|frames| !frames.is_empty());
    if numbers != expected || recording.waveform() != simulator.waveform() {
        return false;
    }
    looked_at.iter().all(|&index| {
        let mut kept = Frame::zeroed(recording.waveform().shape());
        let is_there = recording.seek_frame(index).is_ok()
            && matches!(recording.next_frame(&mut kept), Ok(SourceEvent::Frame))
            && kept.sequence == index;
        is_there && {
            let again = simulator.frame(index);
            (kept.time_ns, kept.shape, kept.truth) == (again.time_ns, again.shape, again.truth)
                && kept.codes == again.codes
        }
    })
}
