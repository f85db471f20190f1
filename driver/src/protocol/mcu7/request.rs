//! Requests: 8-byte header, payload, CRC.

use super::{COMPONENT_RADAR, FIFO_ADDRESS, Protocol, Status};
use crate::chip::SpiWord;
use crate::protocol::crc::crc16;

/// Bytes of a request before its payload.
pub const REQUEST_HEADER_LENGTH: usize = 8;

const BOARD: u8 = 0x80;
const COMPONENT: u8 = 0x20;
const DATA: u8 = 0x0D;
/// Format of data with two codes in three bytes.
const PACKED_12: u8 = 0x10;

/// Direction of a request's payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestKind {
    /// Payload to the board.
    Write,
    /// Payload from the board; the header's length is the length wanted.
    Read,
    /// Payload both ways.
    Transfer,
}

impl RequestKind {
    const ALL: [RequestKind; 3] = [RequestKind::Write, RequestKind::Read, RequestKind::Transfer];

    /// Returns the byte on the wire.
    pub fn code(self, protocol: Protocol) -> u8 {
        match (self, protocol) {
            (RequestKind::Write, Protocol::V4) => 0x40,
            (RequestKind::Read, Protocol::V4) => 0xC0,
            (RequestKind::Transfer, Protocol::V4) => 0x43,
            (RequestKind::Write, Protocol::V3) => 0x41,
            (RequestKind::Read, Protocol::V3) => 0xC1,
            (RequestKind::Transfer, Protocol::V3) => 0xE1,
        }
    }

    /// Decodes the byte on the wire, which also determines the version.
    pub fn from_code(code: u8) -> Option<(Self, Protocol)> {
        let pairs = Protocol::ALL.into_iter().flat_map(|p| RequestKind::ALL.into_iter().map(move |k| (k, p)));
        pairs.into_iter().find(|(kind, protocol)| kind.code(*protocol) == code)
    }
}

/// Request as on the wire.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Version of the protocol whose codes the request has.
    pub protocol: Protocol,
    /// Direction of the payload.
    pub kind: RequestKind,
    /// Group of functions (bRequest).
    pub request: u8,
    /// Function or component (wValue).
    pub value: u16,
    /// Index or function of a component (wIndex).
    pub index: u16,
    /// Bytes of payload sent, or wanted by a read (wLength).
    pub length: u16,
    /// Payload.
    pub payload: Vec<u8>,
}

impl Request {
    /// First byte, which the answer repeats.
    pub fn kind_code(&self) -> u8 {
        self.kind.code(self.protocol)
    }

    /// Encodes the header, which has the form of a USB control transfer's setup packet.
    pub fn header(&self) -> [u8; REQUEST_HEADER_LENGTH] {
        let [[v0, v1], [i0, i1], [l0, l1]] = [self.value, self.index, self.length].map(u16::to_le_bytes);
        [self.kind_code(), self.request, v0, v1, i0, i1, l0, l1]
    }

    /// Encodes the bytes on the serial port.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = self.header().to_vec();
        bytes.extend(&self.payload);
        bytes.extend(crc16(&bytes).to_be_bytes());
        bytes
    }

    /// Returns the number of payload bytes that follow a header; `None` if the kind is unknown.
    pub fn payload_length(header: &[u8; REQUEST_HEADER_LENGTH]) -> Option<usize> {
        let length = usize::from(u16::from_le_bytes([header[6], header[7]]));
        RequestKind::from_code(header[0]).map(|(kind, _)| if kind == RequestKind::Read { 0 } else { length })
    }

    /// Decodes one whole message; `None` if its length, type or CRC is wrong.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (header, rest) = bytes.split_first_chunk::<REQUEST_HEADER_LENGTH>()?;
        let (kind, protocol) = RequestKind::from_code(header[0])?;
        let (payload, _) = rest.split_last_chunk::<2>()?;
        let is_whole = Request::payload_length(header) == Some(payload.len()) && crc16(bytes) == 0;
        is_whole.then(|| Request::new(kind, protocol, header, payload))
    }

    /// Creates a request from its header, whose kind is decoded already, and its payload.
    pub(super) fn new(
        kind: RequestKind,
        protocol: Protocol,
        header: &[u8; REQUEST_HEADER_LENGTH],
        payload: &[u8],
    ) -> Self {
        let &[_, request, v0, v1, i0, i1, l0, l1] = header;
        let [value, index, length] = [[v0, v1], [i0, i1], [l0, l1]].map(u16::from_le_bytes);
        Request { protocol, kind, request, value, index, length, payload: payload.to_vec() }
    }
}

/// Meaning of a request: the part of the protocol that this program uses.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum Command {
    /// USB ids and name.
    BoardInfo,
    /// USB ids and name, cut or filled up with zeros to a length (version 3 only).
    BoardInfoFixed { length: u16 },
    /// Versions of firmware and protocol.
    FirmwareVersion,
    /// 16 bytes of identity.
    Uuid,
    /// Free text about the firmware.
    ExtendedVersion,
    /// Number of components of a type, such as [`COMPONENT_AVIAN`](super::COMPONENT_AVIAN), that the board has.
    ComponentCount { component: u16 },
    /// Implementation of a component type, such as [`COMPONENT_RADAR`], that the board has (version 3 only).
    ComponentImplementation { component: u16 },
    /// Index of the radar chip's data channel.
    DataIndex,
    /// Writes the 24-bit contents of consecutive registers from an address on.
    WriteRegisters { address: u8, values: Vec<u32> },
    /// Reads consecutive registers from an address on.
    ReadRegisters { address: u8, count: u8 },
    /// Sets the bits of a mask in a register and leaves its others as they are.
    SetBits { address: u8, mask: u32 },
    /// Pulls the chip's reset pin.
    HardwareReset,
    /// Level of the chip's interrupt line, one byte.
    InterruptLevel,
    /// SPI words, sent verbatim; `answer` says whether the response is to hold the answers of the chip.
    Execute { words: Vec<SpiWord>, answer: bool },
    /// Configures how the FIFO is read: an even number of codes in a slice, two in three bytes. Stops a running
    /// acquisition.
    ConfigureData { slice_samples: u16 },
    /// Flags of the data channel.
    DataStatus,
    /// Starts reading slices.
    StartData,
    /// Stops reading slices.
    StopData,
}

/// wIndex of a function of a component's interface.
const fn function(interface: u16, function: u16) -> u16 {
    function << 8 | interface << 4
}

const WRITE_BURST: u16 = function(1, 3);
const READ_BURST: u16 = function(1, 4);
const DATA_INDEX: u16 = function(0, 2);
const RESET_PIN: u16 = function(2, 5);
const INTERRUPT_PIN: u16 = function(2, 6);
const EXECUTE: u16 = function(3, 1);
const SET_BITS: u16 = function(3, 2);
/// Data index in version 3.
const DATA_INDEX_V3: u16 = function(0, 7);

impl Command {
    /// Encodes the command as a request. A command that the version lacks is encoded as in the other version: the board
    /// refuses it.
    pub fn to_request(&self, protocol: Protocol) -> Request {
        use RequestKind::{Read, Transfer, Write};
        let avian = protocol.avian_value();
        // The last number is the length wanted by a read.
        let (kind, request, value, index, wanted) = match self {
            Command::BoardInfo => (Transfer, BOARD, 0, 0, 0),
            Command::BoardInfoFixed { length } => (Read, BOARD, 0, 0, *length),
            Command::FirmwareVersion => (Read, BOARD, 1, 0, 16),
            Command::Uuid => (Read, BOARD, 2, 0, 16),
            Command::ExtendedVersion => (Transfer, BOARD, 3, 0, 0),
            Command::ComponentCount { component } => (Read, COMPONENT, 0, *component, 1),
            Command::ComponentImplementation { component } => (Read, COMPONENT, *component, 0, 1),
            Command::DataIndex if protocol == Protocol::V3 => (Read, COMPONENT, COMPONENT_RADAR, DATA_INDEX_V3, 1),
            Command::DataIndex => (Read, COMPONENT, avian, DATA_INDEX, 1),
            Command::WriteRegisters { .. } => (Write, COMPONENT, avian, WRITE_BURST, 0),
            Command::ReadRegisters { .. } => (Transfer, COMPONENT, avian, READ_BURST, 0),
            Command::SetBits { .. } => (Write, COMPONENT, avian, SET_BITS, 0),
            Command::HardwareReset => (Write, COMPONENT, avian, RESET_PIN, 0),
            Command::InterruptLevel => (Read, COMPONENT, avian, INTERRUPT_PIN, 1),
            Command::Execute { answer: true, .. } => (Transfer, COMPONENT, avian, EXECUTE, 0),
            Command::Execute { answer: false, .. } => (Write, COMPONENT, avian, EXECUTE, 0),
            Command::ConfigureData { .. } => (Write, DATA, 1, 0, 0),
            Command::DataStatus => (Read, DATA, 0, 0, 4),
            Command::StartData => (Write, DATA, 3, 0, 0),
            Command::StopData => (Write, DATA, 4, 0, 0),
        };
        let payload = self.payload(protocol);
        let length = if kind == Read { wanted } else { payload.len() as u16 };
        Request { protocol, kind, request, value, index, length, payload }
    }

    /// Encodes the payload of the request.
    fn payload(&self, protocol: Protocol) -> Vec<u8> {
        match self {
            Command::WriteRegisters { address, values } => {
                values.iter().flat_map(|v| v.to_le_bytes()).chain([*address]).collect()
            }
            Command::ReadRegisters { address, count } => match protocol {
                Protocol::V3 => vec![*address, *count],
                Protocol::V4 => vec![*count, *address],
            },
            Command::SetBits { address, mask } => (u32::from(*address) << 24 | mask & 0xFF_FFFF).to_le_bytes().to_vec(),
            Command::Execute { words, .. } => words.iter().flat_map(|w| w.to_bytes()).collect(),
            Command::ConfigureData { slice_samples } => {
                let numbers = [FIFO_ADDRESS, *slice_samples].map(u16::to_le_bytes);
                [&[PACKED_12, 0, 0, 0, 0, 0, 0, 0][..], numbers.as_flattened()].concat()
            }
            _ => Vec::new(),
        }
    }

    /// Decodes a request.
    ///
    /// # Errors
    /// Status that the board answers to a request that it does not know.
    pub fn from_request(request: &Request) -> Result<Self, Status> {
        use RequestKind::{Read, Transfer, Write};
        let protocol = request.protocol;
        let is_v3 = protocol == Protocol::V3;
        match (request.request, request.kind, request.value, request.index) {
            (BOARD, Transfer, 0, _) => Ok(Command::BoardInfo),
            (BOARD, Read, 0, _) if is_v3 => Ok(Command::BoardInfoFixed { length: request.length }),
            (BOARD, Read, 1, _) => Ok(Command::FirmwareVersion),
            (BOARD, Read, 2, _) => Ok(Command::Uuid),
            (BOARD, Transfer, 3, _) => Ok(Command::ExtendedVersion),
            (BOARD, ..) => Err(Status::RequestValueInvalid),
            (COMPONENT, Read, 0, component) if !is_v3 => Ok(Command::ComponentCount { component }),
            (COMPONENT, Read, component, 0) if is_v3 => Ok(Command::ComponentImplementation { component }),
            (COMPONENT, Read, COMPONENT_RADAR, DATA_INDEX_V3) if is_v3 => Ok(Command::DataIndex),
            (COMPONENT, _, component, _) if component == protocol.avian_value() => decode_chip_command(request),
            (COMPONENT, ..) => Err(Status::RequestValueInvalid),
            (DATA, Write, 1, _) => decode_data_configuration(&request.payload),
            (DATA, Read, 0, _) => Ok(Command::DataStatus),
            (DATA, Write, 3, _) => Ok(Command::StartData),
            (DATA, Write, 4, _) => Ok(Command::StopData),
            (DATA, ..) => Err(Status::RequestValueInvalid),
            _ => Err(Status::RequestInvalid),
        }
    }
}

/// Decodes a request to the radar chip.
fn decode_chip_command(request: &Request) -> Result<Command, Status> {
    use RequestKind::{Read, Transfer, Write};
    let Request { protocol, kind, payload, .. } = request;
    let is_v3 = *protocol == Protocol::V3;
    match (request.index, *kind) {
        (DATA_INDEX, Read) if !is_v3 => Ok(Command::DataIndex),
        (WRITE_BURST, Write) => match payload.split_last() {
            Some((&address, values)) if values.len() % 4 == 0 && !values.is_empty() => {
                let values = values.as_chunks::<4>().0.iter().map(|v| u32::from_le_bytes(*v)).collect();
                Ok(Command::WriteRegisters { address, values })
            }
            _ => Err(Status::RequestPayloadInvalid),
        },
        (READ_BURST, Transfer) => match *payload.as_slice() {
            [address, count] if is_v3 => Ok(Command::ReadRegisters { address, count }),
            [count, address] => Ok(Command::ReadRegisters { address, count }),
            _ => Err(Status::RequestPayloadInvalid),
        },
        (SET_BITS, Write) => match payload.as_slice() {
            &[a, b, c, address] => Ok(Command::SetBits { address, mask: u32::from_le_bytes([a, b, c, 0]) }),
            _ => Err(Status::RequestPayloadInvalid),
        },
        (RESET_PIN, Write) => Ok(Command::HardwareReset),
        (INTERRUPT_PIN, Read) => Ok(Command::InterruptLevel),
        (EXECUTE, Write | Transfer) => match payload.as_chunks::<4>() {
            (words, []) => Ok(Command::Execute {
                words: words.iter().map(|w| SpiWord::from_bytes(*w)).collect(),
                answer: *kind == Transfer,
            }),
            _ => Err(Status::RequestPayloadInvalid),
        },
        _ => Err(Status::RequestFunctionInvalid),
    }
}

fn decode_data_configuration(payload: &[u8]) -> Result<Command, Status> {
    let (properties, readouts) = payload.split_first_chunk::<8>().ok_or(Status::InvalidSize)?;
    let &[a0, a1, c0, c1] = readouts else { return Err(Status::InvalidSize) };
    let slice_samples = u16::from_le_bytes([c0, c1]);
    let is_packed = matches!(properties[0], PACKED_12 | 0xFF);
    let is_of_fifo = u16::from_le_bytes([a0, a1]) == FIFO_ADDRESS;
    if !is_packed || !is_of_fifo || slice_samples == 0 || !slice_samples.is_multiple_of(2) {
        return Err(Status::InvalidParameter);
    }
    Ok(Command::ConfigureData { slice_samples })
}
