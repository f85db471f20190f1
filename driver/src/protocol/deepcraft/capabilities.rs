//! Capabilities of a board: devices, their options and streams, as protobuf defines them.

#![allow(missing_docs, reason = "names are the firmware's, and say what most fields are")]

use prost::{Message, Oneof};

/// A version.
#[derive(Clone, PartialEq, Message)]
pub struct Version {
    #[prost(uint32, tag = "1")]
    pub major: u32,
    #[prost(uint32, tag = "2")]
    pub minor: u32,
    #[prost(uint32, tag = "3")]
    pub build: u32,
    #[prost(uint32, tag = "4")]
    pub revision: u32,
}

/// Identity of a board.
#[derive(Clone, PartialEq, Message)]
pub struct BoardSerial {
    /// 16 bytes.
    #[prost(bytes = "vec", tag = "1")]
    pub uuid: Vec<u8>,
}

/// Description of a board.
#[derive(Clone, PartialEq, Message)]
pub struct Board {
    #[prost(message, optional, tag = "1")]
    pub serial: Option<BoardSerial>,
    #[prost(string, tag = "2")]
    pub name: String,
    #[prost(message, optional, tag = "3")]
    pub firmware_version: Option<Version>,
    #[prost(message, optional, tag = "4")]
    pub protocol_version: Option<Version>,
    /// Time without [`WatchdogReset`](super::request::Command::WatchdogReset) after which the board stops, ms; 0 means
    /// never.
    #[prost(int32, tag = "5")]
    pub watchdog_timeout: i32,
    #[prost(message, repeated, tag = "6")]
    pub devices: Vec<Device>,
}

/// Types of [`Device`].
pub mod device_type {
    /// Device that measures.
    pub const SENSOR: i32 = 1;
}

/// Status of a [`Device`].
pub mod device_status {
    /// The device can be started.
    pub const READY: i32 = 0;
    /// The device sends frames.
    pub const ACTIVE: i32 = 1;
    /// The device cannot be used; its message gives the reason.
    pub const ERROR: i32 = 3;
}

/// Device of a board.
#[derive(Clone, PartialEq, Message)]
pub struct Device {
    #[prost(int32, tag = "1")]
    pub device_id: i32,
    #[prost(string, tag = "2")]
    pub name: String,
    #[prost(string, tag = "3")]
    pub description: String,
    /// See [`device_type`].
    #[prost(int32, tag = "4")]
    pub device_type: i32,
    #[prost(message, repeated, tag = "5")]
    pub options: Vec<DeviceOption>,
    #[prost(message, repeated, tag = "6")]
    pub streams: Vec<StreamConfig>,
    /// See [`device_status`].
    #[prost(int32, tag = "7")]
    pub status: i32,
    #[prost(string, tag = "8")]
    pub status_message: String,
}

/// Option of a device.
#[derive(Clone, PartialEq, Message)]
pub struct DeviceOption {
    #[prost(int32, tag = "1")]
    pub option_id: i32,
    #[prost(string, tag = "2")]
    pub name: String,
    #[prost(string, tag = "3")]
    pub description: String,
    /// Kind and value of the option. Kinds that a radar does not have are skipped.
    #[prost(oneof = "OptionKind", tags = "7, 8")]
    pub kind: Option<OptionKind>,
}

/// Kinds of option.
#[derive(Clone, PartialEq, Oneof)]
pub enum OptionKind {
    /// Choice of one of several items.
    #[prost(message, tag = "7")]
    OneOf(OptionOneOf),
    /// Byte string.
    #[prost(message, tag = "8")]
    Blob(OptionBlob),
}

/// Option that is one of several items.
#[derive(Clone, PartialEq, Message)]
pub struct OptionOneOf {
    /// Index of the item at power-up.
    #[prost(int32, tag = "1")]
    pub default_index: i32,
    /// Index of the current item.
    #[prost(int32, tag = "2")]
    pub current_index: i32,
    /// Names of the items.
    #[prost(string, repeated, tag = "3")]
    pub items: Vec<String>,
}

/// Option that is a byte string.
#[derive(Clone, PartialEq, Message)]
pub struct OptionBlob {
    /// Current value.
    #[prost(bytes = "vec", tag = "1")]
    pub current_value: Vec<u8>,
    /// Value at power-up.
    #[prost(bytes = "vec", tag = "2")]
    pub default_value: Vec<u8>,
}

/// Directions of a [`StreamConfig`].
pub mod direction {
    /// From the board to the host.
    pub const OUTPUT: i32 = 2;
}

/// Types of a stream's elements.
pub mod data_type {
    /// Signed, 16 bits.
    pub const S16: i32 = 4;
}

/// Stream of a device. Fields of quantised and fixed-point types are skipped.
#[derive(Clone, PartialEq, Message)]
pub struct StreamConfig {
    #[prost(string, tag = "1")]
    pub name: String,
    /// See [`direction`].
    #[prost(int32, tag = "2")]
    pub direction: i32,
    /// See [`data_type`].
    #[prost(int32, tag = "3")]
    pub data_type: i32,
    /// Axes of a frame. The data need not follow their order: see the [module](super).
    #[prost(message, repeated, tag = "4")]
    pub shape: Vec<Dimension>,
    /// Frames per second, rounded to a whole number.
    #[prost(float, tag = "5")]
    pub frequency: f32,
    /// Most frames in a chunk. The radar states 1 and sends more.
    #[prost(int32, tag = "6")]
    pub max_frame_count: i32,
    #[prost(string, tag = "7")]
    pub unit: String,
    /// Number of the next frame.
    #[prost(int32, tag = "8")]
    pub current_frame: i32,
    #[prost(int32, tag = "9")]
    pub frames_dropped: i32,
}

/// Axis of a frame.
#[derive(Clone, PartialEq, Message)]
pub struct Dimension {
    #[prost(string, tag = "1")]
    pub name: String,
    /// Length of the axis.
    #[prost(int32, tag = "2")]
    pub size: i32,
    /// Names of the elements along the axis.
    #[prost(string, repeated, tag = "3")]
    pub labels: Vec<String>,
}
