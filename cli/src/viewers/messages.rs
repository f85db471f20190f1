//! Messages of an export. The package `foxglove` has the fields of Foxglove's types of the same names. The package
//! `radome` has numbers to plot.

use prost_types::Timestamp;
use prost_types::field_descriptor_proto::Type;

use super::message_type::MessageType;

/// Converts a time in ns since 1970.
pub fn timestamp(time_ns: u64) -> Option<Timestamp> {
    Some(Timestamp { seconds: (time_ns / 1_000_000_000) as i64, nanos: (time_ns % 1_000_000_000) as i32 })
}

/// Protobuf's type of a field by the name that `prost` gives it. The only integers with a sign are enumerations.
const fn field_type(name: &str) -> Type {
    match name.as_bytes() {
        b"message" => Type::Message,
        b"int32" => Type::Enum,
        b"bool" => Type::Bool,
        b"bytes" => Type::Bytes,
        b"double" => Type::Double,
        b"fixed32" => Type::Fixed32,
        b"float" => Type::Float,
        b"string" => Type::String,
        b"uint32" => Type::Uint32,
        b"uint64" => Type::Uint64,
        _ => panic!("a type that no message has yet"),
    }
}

/// Defines a message, whose fields are numbered from 1 on (new ones go last), and the constant that describes its type.
macro_rules! message {
    (
        $(#[$doc:meta])*
        $package:literal, $name:ident, $constant:ident, $enumeration:expr;
        $($(#[$field_doc:meta])* $field:ident: $rust_type:ty = $kind:ident,)+
    ) => {
        #[doc = concat!("Type of [`", stringify!($name), "`].")]
        pub const $constant: MessageType = MessageType {
            package: $package,
            name: stringify!($name),
            fields: &[$((stringify!($field), field_type(stringify!($kind)))),+],
            enumeration: $enumeration,
        };

        $(#[$doc])*
        #[derive(Clone, PartialEq, prost::Message)]
        pub struct $name {
            $($(#[$field_doc])* #[prost($kind)] pub $field: $rust_type,)+
        }
    };
}

message! {
    /// Image without compression.
    "foxglove", RawImage, RAW_IMAGE, None;
    timestamp: Option<Timestamp> = message,
    width: u32 = fixed32,
    height: u32 = fixed32,
    encoding: String = string,
    step: u32 = fixed32,
    data: Vec<u8> = bytes,
    frame_id: String = string,
}

message! {
    /// Image file.
    "foxglove", CompressedImage, COMPRESSED_IMAGE, None;
    timestamp: Option<Timestamp> = message,
    data: Vec<u8> = bytes,
    format: String = string,
    frame_id: String = string,
}

/// Level of a [`Log`] line about an event.
pub const INFO: i32 = 2;
/// Level of a [`Log`] line about a loss.
pub const WARNING: i32 = 3;

message! {
    /// Line of a log.
    "foxglove", Log, LOG, Some(("Level", &["UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"]));
    timestamp: Option<Timestamp> = message,
    level: i32 = int32,
    message: String = string,
    name: String = string,
    file: String = string,
    line: u32 = fixed32,
}

message! {
    /// Numbers of a frame. An unknown number is NaN, which plots skip.
    "radome", State, STATE, None;
    timestamp: Option<Timestamp> = message,
    sequence: u64 = uint64,
    /// Temperature of the chip, degrees Celsius.
    temperature_celsius: f64 = double,
    /// Frame rate by the frames' own clock, from the interval to the previous frame.
    frames_per_s: f64 = double,
    frames_lost: u64 = uint64,
    /// Samples of the frame at either end of the ADC.
    saturated_samples: u32 = uint32,
    /// Class by the frame's ground truth: 0, 1, or 2 for more.
    true_people: f64 = double,
    /// Class by the labels: 0, 1, or 2 for more.
    labelled_people: f64 = double,
}

message! {
    /// Answer of a classifier to a frame. Without a label the text is empty and the probabilities are NaN.
    "radome", Answer, ANSWER, None;
    timestamp: Option<Timestamp> = message,
    sequence: u64 = uint64,
    label: String = string,
    p_empty: f32 = float,
    p_one: f32 = float,
    p_two: f32 = float,
    /// Number of people, after the classifier's delays.
    people: u32 = uint32,
    /// Whether the room is occupied, after the same delays.
    occupied: bool = bool,
    /// Time from the frame's last byte to its label, ms.
    latency_ms: f64 = double,
}
