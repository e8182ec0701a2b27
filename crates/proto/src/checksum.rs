//! Check codes of the three protocols.

/// CRC-16 of Modbus RTU: start 0xFFFF, reflected polynomial 0xA001. On the wire the low-order
/// byte goes first (reference/drives.md, 1.2).
#[allow(clippy::indexing_slicing)] // a byte is a valid index of 256 entries
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes
        .iter()
        .fold(0xFFFF, |crc, &byte| (crc >> 8) ^ TABLE[usize::from((crc as u8) ^ byte)])
}

const TABLE: [u16; 256] = table();

#[allow(clippy::indexing_slicing)] // evaluated by the compiler
const fn table() -> [u16; 256] {
    let mut table = [0u16; 256];
    let mut i = 0;
    while i < 256 {
        let mut crc = i as u16;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 { (crc >> 1) ^ 0xA001 } else { crc >> 1 };
            bit += 1;
        }
        table[i] = crc;
        i += 1;
    }
    table
}

/// LRC of Modbus ASCII: two's complement of the sum of the bytes (reference/drives.md 1.2).
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes
        .iter()
        .fold(0u8, |sum, byte| sum.wrapping_add(*byte))
        .wrapping_neg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crc_of_the_reference() {
        // reference/drives.md 1.2: "0546" printed for bytes 05 46, register holds 0x4605.
        assert_eq!(crc16(&[0x01, 0x03, 0x07, 0xD0, 0x00, 0x03]), 0x4605);
        // The catalogue's check value of CRC-16/MODBUS.
        assert_eq!(crc16(b"123456789"), 0x4B37);
        assert_eq!(crc16(&[]), 0xFFFF);
    }
}
