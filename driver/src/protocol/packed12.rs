//! Two 12-bit codes in three bytes, most significant nibble first: the chip's 24-bit FIFO word as it leaves the SPI.

/// Number of bytes of packed codes; an odd last code takes a whole triple.
pub const fn packed_length(codes: usize) -> usize {
    codes.div_ceil(2) * 3
}

/// Appends codes in packed form. Bits above the twelfth are cut off; an odd last code is followed by a zero.
pub fn pack(codes: &[u16], out: &mut Vec<u8>) {
    out.reserve(packed_length(codes.len()));
    for pair in codes.chunks(2) {
        let (a, b) = (pair[0] & 0xFFF, pair.get(1).map_or(0, |b| b & 0xFFF));
        out.extend([(a >> 4) as u8, ((a << 4) | (b >> 8)) as u8, b as u8]);
    }
}

/// Unpacks as many codes as `out` holds and `bytes` has whole pairs for; returns their number.
pub fn unpack(bytes: &[u8], out: &mut [u16]) -> usize {
    let (triples, _) = bytes.as_chunks::<3>();
    let (pairs, _) = out.as_chunks_mut::<2>();
    for (&[b0, b1, b2], pair) in triples.iter().zip(pairs) {
        let word = u32::from(b0) << 16 | u32::from(b1) << 8 | u32::from(b2);
        *pair = [(word >> 12) as u16, (word & 0xFFF) as u16];
    }
    let codes = (triples.len() * 2).min(out.len());
    if codes % 2 == 1
        && let (Some(last), Some(&[b0, b1, _])) = (out.get_mut(codes - 1), triples.get(codes / 2))
    {
        *last = u16::from(b0) << 4 | u16::from(b1) >> 4;
    }
    codes
}

/// Returns one code by its index, nibble by nibble from the definition; the reference for [`unpack`].
pub fn code_at(bytes: &[u8], index: usize) -> Option<u16> {
    let nibble = |n: usize| bytes.get(n / 2).map(|b| u16::from(if n.is_multiple_of(2) { b >> 4 } else { b & 15 }));
    Some(nibble(3 * index)? << 8 | nibble(3 * index + 1)? << 4 | nibble(3 * index + 2)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn layout_is_that_of_the_fifo_word() {
        let mut bytes = Vec::new();
        pack(&[0xABC, 0xDEF], &mut bytes);
        assert_eq!(bytes, [0xAB, 0xCD, 0xEF]);
    }

    proptest! {
        #[test]
        fn round_trip(codes in prop::collection::vec(0u16..4096, 0..200)) {
            let mut bytes = Vec::new();
            pack(&codes, &mut bytes);
            prop_assert_eq!(bytes.len(), packed_length(codes.len()));
            let mut back = vec![0; codes.len()];
            prop_assert_eq!(unpack(&bytes, &mut back), codes.len());
            prop_assert_eq!(back, codes);
        }

        #[test]
        fn fast_agrees_with_definition(bytes in prop::collection::vec(any::<u8>(), 0..100), room in 0usize..80) {
            let mut codes = vec![0; room];
            let count = unpack(&bytes, &mut codes);
            prop_assert_eq!(count, (bytes.len() / 3 * 2).min(room));
            for (i, code) in codes.iter().take(count).enumerate() {
                prop_assert_eq!(Some(*code), code_at(&bytes, i));
            }
        }
    }
}
