//! Messages of an export. The package `foxglove` has the fields of Foxglove's types of the same names. The package
//! `radome` has numbers to plot.

use prost_types::Timestamp;
use prost_types::field_descriptor_proto::Type;

use super::message_type::{Kind, MessageType};

/// Converts a time in ns since 1970.
pub fn timestamp(time_ns: u64) -> Option<Timestamp> {
    Some(Timestamp { seconds: (time_ns / 1_000_000_000) as i64, nanos: (time_ns % 1_000_000_000) as i32 })
}

/// Type of [`RawImage`].
pub const RAW_IMAGE: MessageType = MessageType {
    package: "foxglove",
    name: "RawImage",
    fields: &[
        ("timestamp", 1, Kind::Timestamp),
        ("width", 2, Kind::Plain(Type::Fixed32)),
        ("height", 3, Kind::Plain(Type::Fixed32)),
        ("encoding", 4, Kind::Plain(Type::String)),
        ("step", 5, Kind::Plain(Type::Fixed32)),
        ("data", 6, Kind::Plain(Type::Bytes)),
        ("frame_id", 7, Kind::Plain(Type::String)),
    ],
    enumeration: None,
};

/// Image without compression.
#[derive(Clone, PartialEq, prost::Message)]
pub struct RawImage {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    /// Pixels in a row.
    #[prost(fixed32, tag = "2")]
    pub width: u32,
    /// Rows.
    #[prost(fixed32, tag = "3")]
    pub height: u32,
    /// Type of a pixel.
    #[prost(string, tag = "4")]
    pub encoding: String,
    /// Bytes in a row.
    #[prost(fixed32, tag = "5")]
    pub step: u32,
    #[prost(bytes = "vec", tag = "6")]
    pub data: Vec<u8>,
    #[prost(string, tag = "7")]
    pub frame_id: String,
}

/// Type of [`CompressedImage`].
pub const COMPRESSED_IMAGE: MessageType = MessageType {
    package: "foxglove",
    name: "CompressedImage",
    fields: &[
        ("timestamp", 1, Kind::Timestamp),
        ("data", 2, Kind::Plain(Type::Bytes)),
        ("format", 3, Kind::Plain(Type::String)),
        ("frame_id", 4, Kind::Plain(Type::String)),
    ],
    enumeration: None,
};

/// Image file.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CompressedImage {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    #[prost(bytes = "vec", tag = "2")]
    pub data: Vec<u8>,
    /// Format of the file.
    #[prost(string, tag = "3")]
    pub format: String,
    #[prost(string, tag = "4")]
    pub frame_id: String,
}

/// Type of [`Log`].
pub const LOG: MessageType = MessageType {
    package: "foxglove",
    name: "Log",
    fields: &[
        ("timestamp", 1, Kind::Timestamp),
        ("level", 2, Kind::Enumeration),
        ("message", 3, Kind::Plain(Type::String)),
        ("name", 4, Kind::Plain(Type::String)),
        ("file", 5, Kind::Plain(Type::String)),
        ("line", 6, Kind::Plain(Type::Fixed32)),
    ],
    enumeration: Some(("Level", &["UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"])),
};

/// Level of a [`Log`] line about an event.
pub const INFO: i32 = 2;
/// Level of a [`Log`] line about a loss.
pub const WARNING: i32 = 3;

/// Line of a log.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Log {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    #[prost(int32, tag = "2")]
    pub level: i32,
    #[prost(string, tag = "3")]
    pub message: String,
    /// Source of the line.
    #[prost(string, tag = "4")]
    pub name: String,
    #[prost(string, tag = "5")]
    pub file: String,
    #[prost(fixed32, tag = "6")]
    pub line: u32,
}

/// Type of [`State`].
pub const STATE: MessageType = MessageType {
    package: "radome",
    name: "State",
    fields: &[
        ("timestamp", 1, Kind::Timestamp),
        ("sequence", 2, Kind::Plain(Type::Uint64)),
        ("temperature_celsius", 3, Kind::Plain(Type::Double)),
        ("frames_per_s", 4, Kind::Plain(Type::Double)),
        ("frames_lost", 5, Kind::Plain(Type::Uint64)),
        ("saturated_samples", 6, Kind::Plain(Type::Uint32)),
        ("true_people", 7, Kind::Plain(Type::Double)),
        ("labelled_people", 8, Kind::Plain(Type::Double)),
    ],
    enumeration: None,
};

/// Numbers of a frame. An unknown number is NaN, which plots skip.
#[derive(Clone, PartialEq, prost::Message)]
pub struct State {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    /// Sequence number of the frame.
    #[prost(uint64, tag = "2")]
    pub sequence: u64,
    /// Temperature of the chip, degrees Celsius.
    #[prost(double, tag = "3")]
    pub temperature_celsius: f64,
    /// Frame rate by the frames' own clock, from the interval to the previous frame.
    #[prost(double, tag = "4")]
    pub frames_per_s: f64,
    /// Frames lost so far.
    #[prost(uint64, tag = "5")]
    pub frames_lost: u64,
    /// Samples of the frame at either end of the ADC.
    #[prost(uint32, tag = "6")]
    pub saturated_samples: u32,
    /// Class by the frame's ground truth: 0, 1, or 2 for more.
    #[prost(double, tag = "7")]
    pub true_people: f64,
    /// Class by the labels: 0, 1, or 2 for more.
    #[prost(double, tag = "8")]
    pub labelled_people: f64,
}

/// Type of [`Answer`].
pub const ANSWER: MessageType = MessageType {
    package: "radome",
    name: "Answer",
    fields: &[
        ("timestamp", 1, Kind::Timestamp),
        ("sequence", 2, Kind::Plain(Type::Uint64)),
        ("label", 3, Kind::Plain(Type::String)),
        ("p_empty", 4, Kind::Plain(Type::Float)),
        ("p_one", 5, Kind::Plain(Type::Float)),
        ("p_two", 6, Kind::Plain(Type::Float)),
        ("people", 7, Kind::Plain(Type::Uint32)),
        ("occupied", 8, Kind::Plain(Type::Bool)),
        ("latency_ms", 9, Kind::Plain(Type::Double)),
    ],
    enumeration: None,
};

/// Answer of a classifier to a frame. Without a label the text is empty and the probabilities are NaN.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Answer {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    /// Sequence number of the frame.
    #[prost(uint64, tag = "2")]
    pub sequence: u64,
    /// Most likely class.
    #[prost(string, tag = "3")]
    pub label: String,
    /// Probability of nobody.
    #[prost(float, tag = "4")]
    pub p_empty: f32,
    /// Probability of one person.
    #[prost(float, tag = "5")]
    pub p_one: f32,
    /// Probability of two people or more.
    #[prost(float, tag = "6")]
    pub p_two: f32,
    /// Number of people, after the classifier's delays.
    #[prost(uint32, tag = "7")]
    pub people: u32,
    /// Whether the room is occupied, after the same delays.
    #[prost(bool, tag = "8")]
    pub occupied: bool,
    /// Time from the frame's last byte to its label, ms.
    #[prost(double, tag = "9")]
    pub latency_ms: f64,
}

#[cfg(test)]
mod tests {
    use prost::Message;

    use super::*;

    /// Returns the wire type of a field.
    fn wire_type(kind: Kind) -> u8 {
        match kind {
            Kind::Plain(Type::Uint32 | Type::Uint64 | Type::Bool) | Kind::Enumeration => 0,
            Kind::Plain(Type::Double) => 1,
            Kind::Plain(Type::String | Type::Bytes) | Kind::Timestamp => 2,
            Kind::Plain(Type::Float | Type::Fixed32) => 5,
            Kind::Plain(other) => panic!("no message has a field of type {other:?}"),
        }
    }

    /// Compares the fields of an encoded message with those of its type. No field has its default value. All field
    /// numbers are below 16 and all values short, so keys and lengths are single bytes.
    fn check(message_type: &MessageType, message: &impl Message) {
        let bytes = message.encode_to_vec();
        let mut found = Vec::new();
        let mut at = 0;
        while at < bytes.len() {
            let (number, wire) = (i32::from(bytes[at] >> 3), bytes[at] & 7);
            found.push((number, wire));
            at += match wire {
                0 => 2,
                1 => 9,
                2 => 2 + usize::from(bytes[at + 1]),
                _ => 5,
            };
        }
        let mut expected: Vec<_> =
            message_type.fields.iter().map(|(_, number, kind)| (*number, wire_type(*kind))).collect();
        expected.sort_unstable();
        assert_eq!(found, expected, "{}", message_type.full_name());
    }

    #[test]
    fn messages_have_the_fields_of_their_types() {
        let (time, text) = (|| timestamp(1_500_000_000), || "a".to_owned());
        let raw_image = RawImage {
            timestamp: time(),
            width: 1,
            height: 1,
            encoding: text(),
            step: 2,
            data: vec![1, 0],
            frame_id: text(),
        };
        check(&RAW_IMAGE, &raw_image);
        let image = CompressedImage { timestamp: time(), data: vec![1], format: text(), frame_id: text() };
        check(&COMPRESSED_IMAGE, &image);
        let log = Log { timestamp: time(), level: INFO, message: text(), name: text(), file: text(), line: 1 };
        check(&LOG, &log);
        let state = State {
            timestamp: time(),
            sequence: 1,
            temperature_celsius: 1.0,
            frames_per_s: 1.0,
            frames_lost: 1,
            saturated_samples: 1,
            true_people: 1.0,
            labelled_people: f64::NAN,
        };
        check(&STATE, &state);
        let answer = Answer {
            timestamp: time(),
            sequence: 1,
            label: text(),
            p_empty: 0.25,
            p_one: 0.25,
            p_two: 0.5,
            people: 1,
            occupied: true,
            latency_ms: 1.0,
        };
        check(&ANSWER, &answer);
    }
}
