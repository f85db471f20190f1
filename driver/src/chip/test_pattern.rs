//! LFSR test pattern of the chip: known words instead of RX1's samples, which test everything behind the ADC.
//!
//! A 12-bit register with the polynomial x^12 + x^11 + x^10 + x^4 + 1 (datasheet V2.4.9, section 10.1) starts at 0x001
//! and steps once a sample. SFCTL's LFSR_EN switches it on. It is assumed to continue from frame to frame.

/// First word of the pattern.
pub const FIRST: u16 = 0x001;
/// Number of words after which the pattern repeats.
pub const PERIOD: usize = 4095;

/// Returns the word that follows `word`.
pub const fn next(word: u16) -> u16 {
    word >> 1 | ((word << 11 ^ word << 10 ^ word << 9 ^ word << 3) & 0x800)
}

/// Comparison of received samples with the pattern.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PatternCheck {
    /// Number of samples compared.
    pub samples: u64,
    /// Number of wrong bits.
    pub wrong_bits: u64,
    /// Next expected word; unknown after a gap.
    expected: Option<u16>,
}

impl PatternCheck {
    /// Creates a check of a stream from its first sample.
    pub fn new() -> Self {
        PatternCheck { expected: Some(FIRST), ..Self::default() }
    }

    /// Compares RX1's next samples, in the order of sampling.
    pub fn check(&mut self, codes: &[u16]) {
        for &code in codes {
            let expected = self.expected.unwrap_or(code);
            self.wrong_bits += u64::from((code ^ expected).count_ones());
            self.expected = Some(next(expected));
        }
        self.samples += codes.len() as u64;
    }

    /// Notes that samples were lost: the next one sets the position in the pattern.
    pub fn after_gap(&mut self) {
        self.expected = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reference, bit by bit from the polynomial: the bit shifted in is the sum of those at the taps.
    fn by_definition(word: u16) -> u16 {
        let bit = |n: u16| word >> n & 1;
        // The register shifts to the right: the oldest bit is the lowest.
        word >> 1 | (bit(0) ^ bit(1) ^ bit(2) ^ bit(8)) << 11
    }

    #[test]
    fn steps_as_the_polynomial_says_and_visits_every_word_but_zero() {
        let (mut word, mut seen) = (FIRST, [false; 4096]);
        for _ in 0..PERIOD {
            assert!(!seen[usize::from(word)]);
            seen[usize::from(word)] = true;
            assert_eq!(next(word), by_definition(word));
            word = next(word);
        }
        assert_eq!((word, seen[0]), (FIRST, false));
    }

    #[test]
    fn a_wrong_bit_counts_once_and_a_gap_is_forgiven() {
        let words: Vec<u16> = std::iter::successors(Some(FIRST), |w| Some(next(*w))).take(100).collect();
        let mut check = PatternCheck::new();
        check.check(&words[..50]);
        let mut bad = words[50..60].to_vec();
        bad[3] ^= 0x010;
        check.check(&bad);
        check.after_gap();
        check.check(&words[80..]);
        assert_eq!((check.samples, check.wrong_bits), (80, 1));
    }
}
