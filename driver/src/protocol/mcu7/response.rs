//! Responses: 4-byte header, payload, CRC.

use thiserror::Error;

use crate::protocol::crc::crc16;

macro_rules! statuses {
    ($($(#[$doc:meta])* $variant:ident = $code:literal, $name:literal;)*) => {
        /// Status of a request.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "names are the firmware's, and say what most are")]
        pub enum Status {
            $($(#[$doc])* $variant,)*
            /// A code that the firmware's list lacks.
            Unknown(u8),
        }

        impl Status {
            /// Returns the byte on the wire.
            pub fn code(self) -> u8 {
                match self { $(Status::$variant => $code,)* Status::Unknown(code) => code }
            }

            /// Decodes the byte on the wire.
            pub fn from_code(code: u8) -> Self {
                match code { $($code => Status::$variant,)* _ => Status::Unknown(code) }
            }

            /// Returns the name as the firmware spells it.
            pub fn name(self) -> &'static str {
                match self { $(Status::$variant => $name,)* Status::Unknown(_) => "unknown status" }
            }
        }

        #[cfg(test)]
        const ALL: &[Status] = &[$(Status::$variant,)*];
    };
}

statuses! {
    Ok = 0x00, "OK";
    /// The function failed for a reason of its own.
    Failed = 0x01, "FAILED";
    InvalidSize = 0x02, "INVALID_SIZE";
    InvalidParameter = 0x03, "INVALID_PARAMETER";
    MissingParameter = 0x04, "MISSING_PARAMETER";
    /// A value is unexpected, such as a stale FIFO overflow after power-up.
    UnexpectedValue = 0x05, "UNEXPECTED_VALUE";
    OutOfBounds = 0x06, "OUT_OF_BOUNDS";
    Overflow = 0x07, "OVERFLOW";
    Timeout = 0x08, "TIMEOUT";
    Busy = 0x09, "BUSY";
    Aborted = 0x0A, "ABORTED";
    Underflow = 0x0B, "UNDERFLOW";
    OutOfMemory = 0x0C, "OUT_OF_MEMORY";
    InvalidAddress = 0x0D, "INVALID_ADDRESS";
    NotImplemented = 0x10, "NOT_IMPLEMENTED";
    NotPossible = 0x11, "NOT_POSSIBLE";
    NotAvailable = 0x12, "NOT_AVAILABLE";
    NotAllowed = 0x13, "NOT_ALLOWED";
    NotInitialized = 0x14, "NOT_INITIALIZED";
    NotConfigured = 0x15, "NOT_CONFIGURED";
    NotOpen = 0x16, "NOT_OPEN";
    NotSupported = 0x17, "NOT_SUPPORTED";
    RequestHeaderIncomplete = 0x80, "REQUEST_HEADER_INCOMPLETE";
    RequestPayloadIncomplete = 0x81, "REQUEST_PAYLOAD_INCOMPLETE";
    RequestPayloadTooLong = 0x82, "REQUEST_PAYLOAD_TOO_LONG";
    /// The request's payload came in pieces.
    RequestPayloadFragmented = 0x83, "REQUEST_PAYLOAD_FRAGMENTED";
    RequestCrc = 0x84, "REQUEST_CRC";
    /// bmReqType is unknown.
    RequestTypeInvalid = 0x85, "REQUEST_TYPE_INVALID";
    /// bRequest is unknown.
    RequestInvalid = 0x86, "REQUEST_INVALID";
    /// The firmware knows the request and cannot serve it.
    RequestNotImplemented = 0x87, "REQUEST_NOT_IMPLEMENTED";
    /// wLength is wrong.
    RequestLengthInvalid = 0x88, "REQUEST_WLENGTH_INVALID";
    /// wValue is wrong.
    RequestValueInvalid = 0x89, "REQUEST_WVALUE_INVALID";
    /// wIndex is wrong.
    RequestIndexInvalid = 0x8A, "REQUEST_WINDEX_INVALID";
    RequestPayloadInvalid = 0x8B, "REQUEST_PAYLOAD_INVALID";
    RequestNotAvailable = 0x8C, "REQUEST_NOT_AVAILABLE";
    /// The component does not exist.
    RequestIdInvalid = 0x8D, "REQUEST_COMMAND_ID_INVALID";
    /// The type of component does not exist.
    RequestComponentInvalid = 0x8E, "REQUEST_COMMAND_TYPE_INVALID";
    /// The component does not have the interface.
    RequestInterfaceInvalid = 0x8F, "REQUEST_SUBIF_INVALID";
    /// The interface does not have the function.
    RequestFunctionInvalid = 0x90, "REQUEST_FUNCTION_INVALID";
}

impl std::fmt::Display for Status {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({:#04x})", self.name(), self.code())
    }
}

/// Answer of a board, with a borrowed payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Response<'a> {
    /// Byte that the request began with.
    pub kind_code: u8,
    /// Status of the request.
    pub status: Status,
    /// Payload of the answer; empty on error.
    pub payload: &'a [u8],
}

impl Response<'_> {
    /// Bytes before the payload.
    pub const HEADER_LENGTH: usize = 4;

    /// Appends the bytes on the wire. A payload longer than a message allows is cut.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let payload = self.payload.get(..super::MAX_MESSAGE - 6).unwrap_or(self.payload);
        let start = out.len();
        out.extend([self.kind_code, self.status.code()]);
        out.extend((payload.len() as u16).to_le_bytes());
        out.extend(payload);
        let crc = crc16(out.get(start..).unwrap_or(&[]));
        out.extend(crc.to_be_bytes());
    }
}

/// Error of a payload that does not have the form of its request.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("strata: the answer to {what} has {got} bytes, expected {expected}")]
pub struct PayloadError {
    /// Name of the request.
    pub what: &'static str,
    /// Bytes received.
    pub got: usize,
    /// Description of the expected payload.
    pub expected: &'static str,
}

/// Answer to `Command::BoardInfo`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BoardInfo {
    /// USB vendor id.
    pub vendor_id: u16,
    /// USB product id.
    pub product_id: u16,
    /// Name of the board.
    pub name: String,
}

impl BoardInfo {
    /// Encodes the payload: ids, name, NUL.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(self.vendor_id.to_le_bytes());
        bytes.extend(self.product_id.to_le_bytes());
        bytes.extend(self.name.as_bytes());
        bytes.push(0);
        bytes
    }

    /// Decodes the payload.
    ///
    /// # Errors
    /// [`PayloadError`] if the payload is too short.
    pub fn decode(payload: &[u8]) -> Result<Self, PayloadError> {
        let error = PayloadError { what: "board info", got: payload.len(), expected: "5 or more" };
        let &[v0, v1, p0, p1, ref name @ ..] = payload else { return Err(error) };
        Ok(BoardInfo {
            vendor_id: u16::from_le_bytes([v0, v1]),
            product_id: u16::from_le_bytes([p0, p1]),
            name: text(name),
        })
    }
}

/// Decodes a NUL-terminated text.
pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes.split(|b| *b == 0).next().unwrap_or(&[])).into_owned()
}

/// Answer to `Command::FirmwareVersion`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FirmwareVersion {
    /// Major, minor, patch, build.
    pub firmware: [u16; 4],
    /// Major and minor of the protocol.
    pub protocol: [u16; 2],
}

impl FirmwareVersion {
    /// Encodes the 16 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let [a, b, c, d] = self.firmware;
        let [e, f] = self.protocol;
        [a, b, c, d, e, f, 0, 0].into_iter().flat_map(u16::to_le_bytes).collect()
    }

    /// Decodes the 16 bytes.
    ///
    /// # Errors
    /// [`PayloadError`] if the payload has another length.
    pub fn decode(payload: &[u8]) -> Result<Self, PayloadError> {
        let error = PayloadError { what: "firmware version", got: payload.len(), expected: "16" };
        if payload.len() != 16 {
            return Err(error);
        }
        let word = |i: usize| payload.get(2 * i..).and_then(|p| p.first_chunk()).map_or(0, |b| u16::from_le_bytes(*b));
        Ok(FirmwareVersion { firmware: [word(0), word(1), word(2), word(3)], protocol: [word(4), word(5)] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_codes_are_distinct_and_round_trip() {
        for status in ALL {
            assert_eq!(Status::from_code(status.code()), *status);
        }
        assert_eq!(Status::from_code(0x42), Status::Unknown(0x42));
        assert_eq!(ALL.len(), 14 + 8 + 17);
    }
}
