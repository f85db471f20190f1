//! Packed samples and FIFO order: compares the fast routines with their definitions, in both directions.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::protocol::fifo::{deinterleave, fifo_index, interleave};
use radome_driver::protocol::packed12::{code_at, pack, packed_length, unpack};
use radome_dsp::FrameShape;

fuzz_target!(|input: &[u8]| {
    let &[rx, chirps, samples, shortage, ref bytes @ ..] = input else { return };
    // Capacity equal to, below or above the number of codes in the bytes.
    let capacity = (bytes.len() / 3 * 2 + 3).saturating_sub(usize::from(shortage % 8));
    let mut codes = vec![0xFFFF; capacity];
    let count = unpack(bytes, &mut codes);
    assert_eq!(count, capacity.min(bytes.len() / 3 * 2));
    for (index, code) in codes.iter().enumerate() {
        assert_eq!(*code, if index < count { code_at(bytes, index).expect("a code") } else { 0xFFFF });
    }
    let mut packed = Vec::new();
    pack(&codes[..count], &mut packed);
    assert_eq!(packed.len(), packed_length(count));
    assert_eq!(packed[..count / 2 * 3], bytes[..count / 2 * 3]);

    let shape =
        FrameShape { rx: usize::from(rx % 5), chirps: usize::from(chirps % 9), samples: usize::from(samples % 33) };
    let mut frame = vec![0xFFFF; shape.codes()];
    deinterleave(&codes, shape, &mut frame);
    for receiver in 0..shape.rx {
        for chirp in 0..shape.chirps {
            for sample in 0..shape.samples {
                let code = frame[(receiver * shape.chirps + chirp) * shape.samples + sample];
                // With three receivers only whole triples are taken.
                let at = fifo_index(shape, receiver, chirp, sample);
                let used = if shape.rx == 3 { codes.len() / 3 * 3 } else { codes.len() };
                assert_eq!(code, if at < used { codes[at] } else { 0xFFFF });
            }
        }
    }
    if codes.len() >= shape.codes() {
        let mut back = Vec::new();
        interleave(&frame, shape, &(0..shape.rx).collect::<Vec<_>>(), &mut back);
        assert_eq!(back, codes[..shape.codes()]);
    }
});
