//! Numbers of the components and registers that requests address.

/// Component type of all BGT60TRxx chips, version 4.
pub const COMPONENT_AVIAN: u16 = 0x0103;
/// Component type of all radar chips, version 3.
pub const COMPONENT_RADAR: u16 = 0x0001;
/// Implementation that version 3 reports for a radar component that is a BGT60TRxx chip.
pub const IMPLEMENTATION_AVIAN: u8 = 3;
/// Register address that stands for the FIFO in a data configuration.
pub const FIFO_ADDRESS: u16 = 0x60;
