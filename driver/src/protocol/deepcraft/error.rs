//! Error codes of a board.

/// Code of an error, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ErrorCode(pub i32);

/// Meanings of the codes -1 to -21, in order.
const NAMES: [&str; 21] = [
    "unspecified error",
    "missing argument",
    "option of another type",
    "no such request",
    "no such response",
    "too many axes",
    "the board cannot send",
    "the board cannot receive",
    "malformed request",
    "the board cannot write its response",
    "no such option",
    "no such device",
    "no such stream",
    "value out of range",
    "device not active",
    "wrong direction of the stream",
    "too many frames",
    "no whole number of frames",
    "the board is out of memory",
    "device already active",
    "another client has the device",
];

#[allow(missing_docs, reason = "the table of names says what each is")]
impl ErrorCode {
    pub const UNSPECIFIED: Self = ErrorCode(-1);
    pub const OPTION_TYPE: Self = ErrorCode(-3);
    pub const REQUEST_TYPE: Self = ErrorCode(-4);
    pub const DECODE: Self = ErrorCode(-9);
    pub const NO_SUCH_OPTION: Self = ErrorCode(-11);
    pub const NO_SUCH_DEVICE: Self = ErrorCode(-12);
    pub const OUT_OF_RANGE: Self = ErrorCode(-14);
    pub const WRONG_DIRECTION: Self = ErrorCode(-16);
    pub const ALREADY_ACTIVE: Self = ErrorCode(-20);

    /// Returns a description.
    pub fn name(self) -> &'static str {
        let index = self.0.checked_neg().and_then(|n| usize::try_from(n - 1).ok());
        index.and_then(|index| NAMES.get(index)).map_or("unknown error", |name| *name)
    }
}

impl std::fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.name(), self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_numbered_as_in_the_firmware() {
        for (code, name) in [
            (ErrorCode::UNSPECIFIED, "unspecified error"),
            (ErrorCode::OPTION_TYPE, "option of another type"),
            (ErrorCode::REQUEST_TYPE, "no such request"),
            (ErrorCode(-6), "too many axes"),
            (ErrorCode::DECODE, "malformed request"),
            (ErrorCode::NO_SUCH_OPTION, "no such option"),
            (ErrorCode::NO_SUCH_DEVICE, "no such device"),
            (ErrorCode::OUT_OF_RANGE, "value out of range"),
            (ErrorCode::WRONG_DIRECTION, "wrong direction of the stream"),
            (ErrorCode::ALREADY_ACTIVE, "device already active"),
            (ErrorCode(-21), "another client has the device"),
            (ErrorCode(-22), "unknown error"),
            (ErrorCode(0), "unknown error"),
            (ErrorCode(i32::MIN), "unknown error"),
            (ErrorCode(i32::MAX), "unknown error"),
        ] {
            assert_eq!(code.name(), name);
        }
    }
}
