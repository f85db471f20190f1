//! Identities of radar chips, as CHIP_ID holds them.

/// Content of CHIP_ID of the BGT60TR13C: digital id and RF id.
pub(crate) const CHIP_ID_BGT60TR13C: u32 = 0x0303;

/// Returns the name of a chip by its CHIP_ID: digital id in bits 23:8, RF id in bits 7:0.
pub(crate) fn chip_name(chip_id: u32) -> &'static str {
    match (chip_id >> 8, chip_id & 0xFF) {
        (3, 3) => "BGT60TR13C",
        (5, 4) => "BGT60ATR24C",
        (6, 6 | 11) => "BGT60UTR13D",
        (7, 7 | 9 | 12) | (8, 12) => "BGT60UTR11AIP",
        _ => "unknown",
    }
}
