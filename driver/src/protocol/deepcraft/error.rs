//! Error codes of a board.

/// Meaning of an error's code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorCode {
    /// No reason given.
    Unspecified,
    /// An argument is missing.
    NullArgument,
    /// The option is of another type.
    OptionType,
    /// No such request.
    RequestType,
    /// No such response.
    ResponseType,
    /// A stream would have too many axes.
    MaxRank,
    /// The board cannot send.
    OutputStream,
    /// The board cannot receive.
    InputStream,
    /// The request is malformed.
    Decode,
    /// The board cannot write its response.
    Encode,
    /// No such option.
    NoSuchOption,
    /// No such device.
    NoSuchDevice,
    /// No such stream.
    NoSuchStream,
    /// The value is not one that the option takes.
    OutOfRange,
    /// The device is not active.
    NotActive,
    /// The stream goes the other way.
    WrongDirection,
    /// More frames than the stream takes.
    FrameCount,
    /// Not a whole number of frames.
    FrameSize,
    /// The board is out of memory.
    Memory,
    /// The device is active already.
    AlreadyActive,
    /// Another client has the device.
    Busy,
    /// Unknown code.
    Other(i32),
}

impl ErrorCode {
    /// Codes -1 to -21, in order, in words.
    const ALL: [(ErrorCode, &'static str); 21] = [
        (ErrorCode::Unspecified, "unspecified error"),
        (ErrorCode::NullArgument, "missing argument"),
        (ErrorCode::OptionType, "option of another type"),
        (ErrorCode::RequestType, "no such request"),
        (ErrorCode::ResponseType, "no such response"),
        (ErrorCode::MaxRank, "too many axes"),
        (ErrorCode::OutputStream, "the board cannot send"),
        (ErrorCode::InputStream, "the board cannot receive"),
        (ErrorCode::Decode, "malformed request"),
        (ErrorCode::Encode, "the board cannot write its response"),
        (ErrorCode::NoSuchOption, "no such option"),
        (ErrorCode::NoSuchDevice, "no such device"),
        (ErrorCode::NoSuchStream, "no such stream"),
        (ErrorCode::OutOfRange, "value out of range"),
        (ErrorCode::NotActive, "device not active"),
        (ErrorCode::WrongDirection, "wrong direction of the stream"),
        (ErrorCode::FrameCount, "too many frames"),
        (ErrorCode::FrameSize, "no whole number of frames"),
        (ErrorCode::Memory, "the board is out of memory"),
        (ErrorCode::AlreadyActive, "device already active"),
        (ErrorCode::Busy, "another client has the device"),
    ];

    /// Decodes the number on the wire.
    pub fn from_code(code: i32) -> Self {
        let known = code.checked_neg().and_then(|n| Self::ALL.get(usize::try_from(n - 1).ok()?));
        known.map_or(ErrorCode::Other(code), |(error, _)| *error)
    }

    /// Returns the number on the wire.
    pub fn code(self) -> i32 {
        match self {
            ErrorCode::Other(code) => code,
            known => Self::ALL.iter().zip(1..).find(|((error, _), _)| *error == known).map_or(-1, |(_, n)| -n),
        }
    }

    /// Returns a description.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(error, _)| *error == self).map_or("unknown error", |(_, name)| name)
    }
}

impl std::fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.name(), self.code())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Figures captured from the firmware.
    #[test]
    fn codes_are_numbered_as_in_the_firmware() {
        for (code, name) in [
            (-1, ErrorCode::Unspecified),
            (-6, ErrorCode::MaxRank),
            (-9, ErrorCode::Decode),
            (-11, ErrorCode::NoSuchOption),
            (-12, ErrorCode::NoSuchDevice),
            (-14, ErrorCode::OutOfRange),
            (-20, ErrorCode::AlreadyActive),
            (-21, ErrorCode::Busy),
            (-22, ErrorCode::Other(-22)),
            (0, ErrorCode::Other(0)),
            (i32::MIN, ErrorCode::Other(i32::MIN)),
            (i32::MAX, ErrorCode::Other(i32::MAX)),
        ] {
            assert_eq!((ErrorCode::from_code(code), name.code()), (name, code));
        }
    }
}
