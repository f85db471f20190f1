//! Asserts that maps are computed from frames without allocation. The allocator of this test program counts by thread.

mod counting;

use counting::ALLOCATIONS;
use radome_dsp::rdm::{Channels, PhysicalAxes, SlowTime, StaticRemoval};
use radome_dsp::{Frame, KernelLevel, RdmProcessor, RdmSpec, Waveform, WaveformRequest};

#[test]
fn no_transform_allocates_once_it_is_planned() {
    let waveform = |chirps: usize, samples: usize| {
        let request = WaveformRequest {
            samples_per_chirp: samples,
            chirps_per_frame: chirps,
            frame_interval_s: 0.2,
            ..WaveformRequest::paper()
        };
        Waveform::realise(request).expect("valid")
    };
    let base = RdmSpec::default();
    let axes = PhysicalAxes { range_step_m: 0.4, range_bins: 60, velocity_step_m_per_s: 0.1, velocity_bins: 90 };
    let specs = [
        base,
        RdmSpec::paper(),
        RdmSpec { channels: Channels::IncoherentSum, static_removal: StaticRemoval::SlowTimeMean, ..base },
        RdmSpec { static_removal: StaticRemoval::RecursiveMti { alpha: 0.6 }, chirp_mean_removal: true, ..base },
        RdmSpec { slow_time: SlowTime::Frames { frames: 8 }, ..base },
        RdmSpec { channels: Channels::IncoherentSum, physical_axes: Some(axes), motion_over_s: Some(1.0), ..base },
    ];
    // Sizes of the lane transform and of the library transform.
    for waveform in [waveform(128, 256), waveform(32, 64), waveform(20, 100)] {
        for spec in specs {
            for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
                let mut processor = RdmProcessor::with_kernel(&spec, &waveform, level).expect("spec fits");
                let (mut map, mut frame) = (processor.empty_map(), Frame::zeroed(waveform.shape()));
                let mut process = |sequences: std::ops::Range<u64>| {
                    for sequence in sequences {
                        frame.sequence = sequence;
                        frame
                            .codes
                            .iter_mut()
                            .enumerate()
                            .for_each(|(i, code)| *code = (i as u64 * sequence % 4096) as u16);
                        processor.process(&frame, &mut map).expect("frame fits");
                    }
                };
                process(0..10);
                let before = ALLOCATIONS.get();
                assert!(before > 0, "the allocator counts");
                // The jump of the sequence number resets the state.
                process(10..20);
                process(30..40);
                assert_eq!(ALLOCATIONS.get() - before, 0, "{level}, {}, {spec:?}", waveform.shape());
            }
        }
    }
}
