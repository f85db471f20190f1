//! CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, not reflected, nothing xored out.

const POLYNOMIAL: u16 = 0x1021;
const INITIAL: u16 = 0xFFFF;

/// CRC register after eight further zero bits.
const fn shift_byte(mut crc: u16) -> u16 {
    let mut bit = 0;
    while bit < 8 {
        crc = if crc & 0x8000 != 0 { (crc << 1) ^ POLYNOMIAL } else { crc << 1 };
        bit += 1;
    }
    crc
}

/// Entry `[n][byte]`: CRC of a byte that `n` zero bytes follow.
static TABLES: [[u16; 256]; 8] = {
    let mut tables = [[0; 256]; 8];
    let mut i = 0;
    while i < 256 {
        tables[0][i] = shift_byte((i as u16) << 8);
        let mut n = 1;
        while n < 8 {
            tables[n][i] = shift_byte(tables[n - 1][i]);
            n += 1;
        }
        i += 1;
    }
    tables
};

/// Computes the CRC of these bytes, with one table look-up per byte. It takes eight bytes at a time, because their
/// look-ups do not depend on each other.
pub fn crc16(bytes: &[u8]) -> u16 {
    let (blocks, rest) = bytes.as_chunks::<8>();
    let at = |n: usize, byte: u8| TABLES[n][usize::from(byte)];
    let crc = blocks.iter().fold(INITIAL, |crc, &[b0, b1, b2, b3, b4, b5, b6, b7]| {
        let [high, low] = crc.to_be_bytes();
        at(7, high ^ b0) ^ at(6, low ^ b1) ^ at(5, b2) ^ at(4, b3) ^ at(3, b4) ^ at(2, b5) ^ at(1, b6) ^ at(0, b7)
    });
    rest.iter().fold(crc, |crc, &byte| (crc << 8) ^ at(0, (crc >> 8) as u8 ^ byte))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Computes the CRC of these bytes, bit by bit from the definition.
    fn crc16_bitwise(bytes: &[u8]) -> u16 {
        bytes.iter().fold(INITIAL, |crc, &byte| shift_byte(crc ^ (u16::from(byte) << 8)))
    }

    /// The check value of the CRC catalogue.
    #[test]
    fn check_value() {
        assert_eq!(crc16(b"123456789"), 0x29B1);
        assert_eq!(crc16_bitwise(b"123456789"), 0x29B1);
    }

    proptest! {
        #[test]
        fn table_agrees_with_definition(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert_eq!(crc16(&bytes), crc16_bitwise(&bytes));
        }

        #[test]
        fn crc_over_message_and_crc_is_zero(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            let mut bytes = bytes;
            bytes.extend(crc16(&bytes).to_be_bytes());
            prop_assert_eq!(crc16(&bytes), 0);
        }
    }
}
