//! Count of codes at either end of the ADC's range.

use crate::{MAX_CODE, dispatch};

dispatch! {
    /// Number of codes that are 0, or [`MAX_CODE`] or above (the chip cannot send more).
    pub(super) fn saturated_codes(codes: &[u16]) -> u32 = count_saturated
}

#[inline(always)]
fn count_saturated<const FUSED: bool>(codes: &[u16]) -> u32 {
    let mut total = 0;
    // Sums of 16 bits fill as many vector lanes as codes do. A chunk is too short to overflow them.
    for chunk in codes.chunks(4096) {
        let mut sum = 0u16;
        for code in chunk {
            // One comparison for both ends: 0 wraps to the largest number.
            sum += u16::from(code.wrapping_sub(1) >= MAX_CODE - 1);
        }
        total += u32::from(sum);
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::KernelLevel;

    #[test]
    fn every_level_counts_both_ends_and_what_lies_beyond() {
        let codes: Vec<u16> = (0..10_000u32).map(|i| (i * 7 % 4100) as u16).collect();
        let expected = codes.iter().filter(|c| **c == 0 || **c >= MAX_CODE).count() as u32;
        for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
            assert_eq!(saturated_codes(level, &codes), expected, "{level}");
            assert_eq!(saturated_codes(level, &vec![0; 70_000]), 70_000, "{level}");
        }
    }
}
