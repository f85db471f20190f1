//! Versions of the protocol: the same messages under other codes.

/// Version of the protocol. Firmware of one version refuses the codes of the other (`REQUEST_TYPE_INVALID`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Protocol {
    /// Boards delivered with SDKs up to 3.3.
    V3,
    /// Boards with firmware for SDK 3.4 and later.
    #[default]
    V4,
}

impl Protocol {
    /// All supported versions, newest first: the order in which a client tries them.
    pub const ALL: [Protocol; 2] = [Protocol::V4, Protocol::V3];

    /// Major number, as the firmware reports it.
    pub fn major(self) -> u16 {
        match self {
            Protocol::V3 => 3,
            Protocol::V4 => 4,
        }
    }

    /// wValue of requests to a radar chip: version 3 has implementation and type the other way round.
    pub(super) fn avian_value(self) -> u16 {
        match self {
            Protocol::V3 => 0x0301,
            Protocol::V4 => super::COMPONENT_AVIAN,
        }
    }
}
