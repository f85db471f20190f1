//! Requests of a host, as protobuf defines them. Absent fields are zero.

#![allow(missing_docs, reason = "names are the firmware's, and say what most fields are")]

use prost::{Message, Oneof};

use super::option::OptionValue;
use super::response::DataChunk;

/// Device number that stands for all devices where a request allows it.
pub const ALL_DEVICES: i32 = -1;

/// Request of the host.
#[derive(Clone, PartialEq, Message)]
pub struct Request {
    #[prost(oneof = "Command", tags = "1, 2, 3, 4, 5, 6, 7")]
    pub command: Option<Command>,
}

/// Kinds of request. Start, stop and the resets have no answer unless they fail.
#[derive(Clone, PartialEq, Oneof)]
pub enum Command {
    #[prost(message, tag = "1")]
    Capabilities(CapabilitiesRequest),
    /// Sets options of a device that is not active.
    #[prost(message, tag = "2")]
    Configure(ConfigureRequest),
    #[prost(message, tag = "3")]
    Start(StartRequest),
    #[prost(message, tag = "4")]
    Stop(StopRequest),
    /// Tells the board that the host is alive.
    #[prost(message, tag = "5")]
    WatchdogReset(Empty),
    /// Data for a device that takes data.
    #[prost(message, tag = "6")]
    Data(DataChunk),
    #[prost(message, tag = "7")]
    Reset(Empty),
}

/// Request for the capabilities of a board.
#[derive(Clone, PartialEq, Message)]
pub struct CapabilitiesRequest {
    /// Device, or [`ALL_DEVICES`].
    #[prost(sint32, tag = "1")]
    pub device: i32,
    /// Tag that the answer repeats.
    #[prost(int32, tag = "2")]
    pub tag: i32,
}

/// Request to set options of a device.
#[derive(Clone, PartialEq, Message)]
pub struct ConfigureRequest {
    #[prost(int32, tag = "1")]
    pub device: i32,
    /// Options to set; the others stay as they are.
    #[prost(message, repeated, tag = "2")]
    pub options: Vec<OptionValue>,
    /// Tag that the answer repeats.
    #[prost(int32, tag = "3")]
    pub tag: i32,
}

/// Request to start a device.
#[derive(Clone, PartialEq, Message)]
pub struct StartRequest {
    #[prost(int32, tag = "1")]
    pub device: i32,
}

/// Request to stop a device.
#[derive(Clone, PartialEq, Message)]
pub struct StopRequest {
    /// Device, or [`ALL_DEVICES`].
    #[prost(sint32, tag = "1")]
    pub device: i32,
}

/// Message without fields.
#[derive(Clone, PartialEq, Message)]
pub struct Empty {}

impl From<Command> for Request {
    fn from(command: Command) -> Self {
        Request { command: Some(command) }
    }
}

impl Request {
    /// Appends the request as it stands on the line.
    pub fn encode_to(&self, out: &mut Vec<u8>) {
        out.extend(self.encode_length_delimited_to_vec());
    }
}
