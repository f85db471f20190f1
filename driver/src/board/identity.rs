//! Identities of boards.

use serde::{Deserialize, Serialize};

/// Identity that a board reports. Recordings hold it under these field names.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BoardIdentity {
    /// Name of the board.
    pub name: String,
    /// USB vendor id.
    pub vendor_id: u16,
    /// USB product id.
    pub product_id: u16,
    /// Version of the firmware: major, minor, patch.
    pub firmware_version: String,
    /// Text in which the firmware describes itself further.
    pub extended_version: String,
    /// Version of the protocol: major, minor.
    pub protocol_version: String,
    /// Unique identifier of the board, 32 hexadecimal digits; all zero where it has none.
    pub uuid: String,
    /// Name of the radar chip.
    pub chip: String,
    /// Content of the chip's CHIP_ID register.
    pub chip_id: u32,
}
