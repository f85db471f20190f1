//! Responses of a board, as protobuf defines them. Fields that a newer firmware adds are skipped; absent fields are
//! zero.

#![allow(missing_docs, reason = "names are the firmware's, and say what most fields are")]

use prost::{Message, Oneof};

use super::capabilities::{Board, StreamConfig};
use super::option::OptionValue;

/// Response of a board.
#[derive(Clone, PartialEq, Message)]
pub struct Response {
    #[prost(oneof = "Answer", tags = "1, 2, 3, 4")]
    pub answer: Option<Answer>,
}

/// Kinds of answer; data and errors also come without a request.
#[derive(Clone, PartialEq, Oneof)]
pub enum Answer {
    #[prost(message, tag = "1")]
    Capabilities(CapabilitiesResponse),
    #[prost(message, tag = "2")]
    Configuration(ConfigureResponse),
    #[prost(message, tag = "3")]
    Error(ErrorResponse),
    #[prost(message, tag = "4")]
    Data(DataChunk),
}

/// Capabilities of a board.
#[derive(Clone, PartialEq, Message)]
pub struct CapabilitiesResponse {
    #[prost(message, optional, tag = "1")]
    pub board: Option<Board>,
    #[prost(int32, tag = "2")]
    pub tag: i32,
}

/// Configuration of a device.
#[derive(Clone, PartialEq, Message)]
pub struct ConfigureResponse {
    #[prost(int32, tag = "1")]
    pub device: i32,
    #[prost(message, repeated, tag = "2")]
    pub options: Vec<OptionValue>,
    #[prost(message, repeated, tag = "3")]
    pub streams: Vec<StreamConfig>,
    /// One of [`super::device_status`].
    #[prost(int32, tag = "4")]
    pub status: i32,
    #[prost(string, tag = "5")]
    pub status_message: String,
    #[prost(int32, tag = "6")]
    pub tag: i32,
}

/// Error of a request.
#[derive(Clone, PartialEq, Message)]
pub struct ErrorResponse {
    #[prost(string, tag = "1")]
    pub message: String,
    /// See [`super::ErrorCode`].
    #[prost(int32, tag = "2")]
    pub code: i32,
}

/// Frames of a stream. [`super::ChunkParser`] reads them without this type.
#[derive(Clone, PartialEq, Message)]
pub struct DataChunk {
    #[prost(int32, tag = "1")]
    pub device: i32,
    #[prost(int32, tag = "2")]
    pub stream: i32,
    /// Frames in the payload.
    #[prost(int32, tag = "3")]
    pub frame_count: i32,
    /// Number of the first frame; frames that the device has dropped are counted too.
    #[prost(int32, tag = "4")]
    pub frame_number: i32,
    /// Elements of the frames.
    #[prost(bytes = "vec", tag = "5")]
    pub payload: Vec<u8>,
    /// Times of the frames if the stream has no frequency.
    #[prost(message, repeated, tag = "6")]
    pub timestamps: Vec<Timestamp>,
}

/// Time of a frame.
#[derive(Clone, PartialEq, Message)]
pub struct Timestamp {
    #[prost(int64, tag = "1")]
    pub timestamp: i64,
    /// Duration; 0 if it is not stated.
    #[prost(int32, tag = "2")]
    pub duration: i32,
}

impl From<Answer> for Response {
    fn from(answer: Answer) -> Self {
        Response { answer: Some(answer) }
    }
}

impl Response {
    /// Appends the response as it stands on the line.
    pub fn encode_to(&self, out: &mut Vec<u8>) {
        out.extend(self.encode_length_delimited_to_vec());
    }
}
