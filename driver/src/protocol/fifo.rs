//! Order of codes in the chip's FIFO: chirp by chirp, in a chirp sample by sample, in a sample the enabled receivers
//! in ascending order. Frames are `[rx][chirp][sample]`.

use radome_dsp::{Frame, FrameShape, Waveform};

/// Reorders codes from FIFO order to frame order `[rx][chirp][sample]`. Codes that either slice lacks are left as they
/// are.
pub fn deinterleave(fifo: &[u16], shape: FrameShape, codes: &mut [u16]) {
    let FrameShape { rx, chirps, samples } = shape;
    let plane = chirps * samples;
    if plane == 0 || rx == 0 {
        return;
    }
    match rx {
        1 => codes.iter_mut().zip(fifo).for_each(|(c, f)| *c = *f),
        3 if codes.len() >= 3 * plane => {
            let (triples, _) = fifo.as_chunks::<3>();
            let (first, rest) = codes.split_at_mut(plane);
            let (second, third) = rest.split_at_mut(plane);
            for (((a, b), c), triple) in first.iter_mut().zip(second).zip(third).zip(triples) {
                [*a, *b, *c] = *triple;
            }
        }
        _ => {
            for (channel, plane) in codes.chunks_mut(plane).take(rx).enumerate() {
                plane.iter_mut().zip(fifo.iter().skip(channel).step_by(rx)).for_each(|(c, f)| *c = *f);
            }
        }
    }
}

/// Fills a frame from its codes in FIFO order. Protocols without time stamps need this: the time of the frame follows from
/// its number and the frame interval.
pub(crate) fn fill_frame(fifo: &[u16], waveform: &Waveform, sequence: u64, frame: &mut Frame) {
    frame.shape = waveform.shape();
    frame.codes.resize(frame.shape.codes(), 0);
    deinterleave(fifo, frame.shape, &mut frame.codes);
    frame.sequence = sequence;
    frame.time_ns = waveform.frame_time_ns(sequence);
    (frame.truth, frame.temperature_millicelsius) = (None, None);
}

/// Appends codes in FIFO order from frame order. `channels` are the indices on the frame's first axis to take, in
/// order.
pub fn interleave(codes: &[u16], shape: FrameShape, channels: &[usize], fifo: &mut Vec<u16>) {
    let plane = shape.chirps * shape.samples;
    let start = fifo.len();
    fifo.resize(start + plane * channels.len(), 0);
    for (position, &channel) in channels.iter().enumerate() {
        let source = codes.chunks(plane.max(1)).nth(channel).unwrap_or(&[]);
        let target = fifo.iter_mut().skip(start + position).step_by(channels.len());
        target.zip(source).for_each(|(f, c)| *f = *c);
    }
}

/// Index of a frame's code in FIFO order, from the definition; the reference for the fast routines.
pub fn fifo_index(shape: FrameShape, rx: usize, chirp: usize, sample: usize) -> usize {
    (chirp * shape.samples + sample) * shape.rx + rx
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_agrees_with_definition_and_round_trips() {
        for rx in 1..=4 {
            let shape = FrameShape { rx, chirps: 3, samples: 5 };
            let fifo: Vec<u16> = (0..shape.codes() as u16).collect();
            let mut codes = vec![0; shape.codes()];
            deinterleave(&fifo, shape, &mut codes);
            for r in 0..rx {
                for c in 0..3 {
                    for s in 0..5 {
                        assert_eq!(codes[(r * 3 + c) * 5 + s], fifo[fifo_index(shape, r, c, s)]);
                    }
                }
            }
            let mut back = Vec::new();
            interleave(&codes, shape, &(0..rx).collect::<Vec<_>>(), &mut back);
            assert_eq!(back, fifo);
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn short_input_does_not_panic() {
            for rx in 0..4 {
                let shape = FrameShape { rx, chirps: 2, samples: 4 };
                let mut codes = vec![7; 5];
                deinterleave(&[1, 2], shape, &mut codes);
                interleave(&codes, shape, &[0, 2], &mut Vec::new());
            }
        }
    }
}
