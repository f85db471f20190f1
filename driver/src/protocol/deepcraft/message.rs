//! The messages, as protobuf defines them. Fields that a newer firmware adds are skipped; those that are absent are zero.

use prost::{Message, Oneof};

use super::delimited;

/// Device number that stands for all of them where a request allows it.
pub const ALL_DEVICES: i32 = -1;

/// What the host asks.
#[derive(Clone, PartialEq, Message)]
pub struct Request {
    /// The request proper.
    #[prost(oneof = "Command", tags = "1, 2, 3, 4, 5, 6, 7")]
    pub command: Option<Command>,
}

/// Kinds of request. Start, stop and the resets have no answer unless something is wrong with them.
#[derive(Clone, PartialEq, Oneof)]
pub enum Command {
    /// Who are you?
    #[prost(message, tag = "1")]
    Capabilities(CapabilitiesRequest),
    /// Sets options of a device that is not active.
    #[prost(message, tag = "2")]
    Configure(ConfigureRequest),
    /// Starts a device.
    #[prost(message, tag = "3")]
    Start(StartRequest),
    /// Stops a device.
    #[prost(message, tag = "4")]
    Stop(StopRequest),
    /// The host is alive.
    #[prost(message, tag = "5")]
    WatchdogReset(Empty),
    /// Data for a device that takes some.
    #[prost(message, tag = "6")]
    Data(DataChunk),
    /// Resets the board.
    #[prost(message, tag = "7")]
    Reset(Empty),
}

/// Asks what a board has.
#[derive(Clone, PartialEq, Message)]
pub struct CapabilitiesRequest {
    /// Device, or [`ALL_DEVICES`].
    #[prost(sint32, tag = "1")]
    pub device: i32,
    /// Comes back in the answer.
    #[prost(int32, tag = "2")]
    pub tag: i32,
}

/// Sets options of a device.
#[derive(Clone, PartialEq, Message)]
pub struct ConfigureRequest {
    /// Device.
    #[prost(int32, tag = "1")]
    pub device: i32,
    /// Options to set; others stay as they are.
    #[prost(message, repeated, tag = "2")]
    pub options: Vec<OptionValue>,
    /// Comes back in the answer.
    #[prost(int32, tag = "3")]
    pub tag: i32,
}

/// Starts a device.
#[derive(Clone, PartialEq, Message)]
pub struct StartRequest {
    /// Device.
    #[prost(int32, tag = "1")]
    pub device: i32,
}

/// Stops a device.
#[derive(Clone, PartialEq, Message)]
pub struct StopRequest {
    /// Device, or [`ALL_DEVICES`].
    #[prost(sint32, tag = "1")]
    pub device: i32,
}

/// A message without fields.
#[derive(Clone, PartialEq, Message)]
pub struct Empty {}

/// An option's value.
#[derive(Clone, PartialEq, Message)]
pub struct OptionValue {
    /// Option.
    #[prost(int32, tag = "1")]
    pub option_id: i32,
    /// Its value.
    #[prost(oneof = "Value", tags = "2, 3, 4, 5, 6, 7, 8")]
    pub value: Option<Value>,
}

/// Values by type.
#[derive(Clone, PartialEq, Oneof)]
pub enum Value {
    /// A number.
    #[prost(int32, tag = "2")]
    Int(i32),
    /// A number.
    #[prost(float, tag = "3")]
    Float(f32),
    /// On or off.
    #[prost(bool, tag = "4")]
    Bool(bool),
    /// Index into the items of the option.
    #[prost(int32, tag = "5")]
    OneOf(i32),
    /// Bytes.
    #[prost(bytes, tag = "6")]
    Blob(Vec<u8>),
    /// Text.
    #[prost(string, tag = "7")]
    Text(String),
    /// A secret.
    #[prost(string, tag = "8")]
    Password(String),
}

/// What a board says.
#[derive(Clone, PartialEq, Message)]
pub struct Response {
    /// The answer proper.
    #[prost(oneof = "Answer", tags = "1, 2, 3, 4, 5")]
    pub answer: Option<Answer>,
}

/// Kinds of answer; data and errors also come unasked.
#[derive(Clone, PartialEq, Oneof)]
pub enum Answer {
    /// What the board has.
    #[prost(message, tag = "1")]
    Capabilities(CapabilitiesResponse),
    /// How the device is set now.
    #[prost(message, tag = "2")]
    Configuration(ConfigureResponse),
    /// Something is wrong with a request.
    #[prost(message, tag = "3")]
    Error(ErrorResponse),
    /// Frames.
    #[prost(message, tag = "4")]
    Data(DataChunk),
    /// A device wants data.
    #[prost(message, tag = "5")]
    DataInquire(DataInquire),
}

/// What a board has.
#[derive(Clone, PartialEq, Message)]
pub struct CapabilitiesResponse {
    /// The board.
    #[prost(message, optional, tag = "1")]
    pub board: Option<Board>,
    /// Tag of the request.
    #[prost(int32, tag = "2")]
    pub tag: i32,
}

/// How a device is set.
#[derive(Clone, PartialEq, Message)]
pub struct ConfigureResponse {
    /// Device.
    #[prost(int32, tag = "1")]
    pub device: i32,
    /// All of its options.
    #[prost(message, repeated, tag = "2")]
    pub options: Vec<OptionValue>,
    /// Its streams.
    #[prost(message, repeated, tag = "3")]
    pub streams: Vec<StreamConfig>,
    /// One of [`device_status`].
    #[prost(int32, tag = "4")]
    pub status: i32,
    /// What it says of its status.
    #[prost(string, tag = "5")]
    pub status_message: String,
    /// Tag of the request.
    #[prost(int32, tag = "6")]
    pub tag: i32,
}

/// Something is wrong with a request.
#[derive(Clone, PartialEq, Message)]
pub struct ErrorResponse {
    /// In words.
    #[prost(string, tag = "1")]
    pub message: String,
    /// See [`super::ErrorCode`].
    #[prost(int32, tag = "2")]
    pub code: i32,
}

/// Frames of a stream. [`super::ChunkParser`] reads them without this type.
#[derive(Clone, PartialEq, Message)]
pub struct DataChunk {
    /// Device.
    #[prost(int32, tag = "1")]
    pub device: i32,
    /// Stream of the device.
    #[prost(int32, tag = "2")]
    pub stream: i32,
    /// Frames in the payload.
    #[prost(int32, tag = "3")]
    pub frame_count: i32,
    /// Number of the first one; it counts frames, those that the device dropped included.
    #[prost(int32, tag = "4")]
    pub frame_number: i32,
    /// The frames' elements.
    #[prost(bytes = "vec", tag = "5")]
    pub payload: Vec<u8>,
    /// Times of the frames where the stream has no frequency.
    #[prost(message, repeated, tag = "6")]
    pub timestamps: Vec<Timestamp>,
}

/// Time of a frame.
#[derive(Clone, PartialEq, Message)]
pub struct Timestamp {
    /// Time.
    #[prost(int64, tag = "1")]
    pub timestamp: i64,
    /// Duration, 0 where it is not told.
    #[prost(int32, tag = "2")]
    pub duration: i32,
}

/// A device wants data.
#[derive(Clone, PartialEq, Message)]
pub struct DataInquire {
    /// Device.
    #[prost(int32, tag = "1")]
    pub device: i32,
    /// Stream of the device.
    #[prost(int32, tag = "2")]
    pub stream: i32,
    /// Frames wanted.
    #[prost(int32, tag = "3")]
    pub frame_count: i32,
}

/// A version.
#[derive(Clone, PartialEq, Message)]
pub struct Version {
    /// Major.
    #[prost(uint32, tag = "1")]
    pub major: u32,
    /// Minor.
    #[prost(uint32, tag = "2")]
    pub minor: u32,
    /// Build.
    #[prost(uint32, tag = "3")]
    pub build: u32,
    /// Revision.
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

/// A board.
#[derive(Clone, PartialEq, Message)]
pub struct Board {
    /// Which one of its kind.
    #[prost(message, optional, tag = "1")]
    pub serial: Option<BoardSerial>,
    /// Its name.
    #[prost(string, tag = "2")]
    pub name: String,
    /// Of the firmware.
    #[prost(message, optional, tag = "3")]
    pub firmware_version: Option<Version>,
    /// Of the protocol.
    #[prost(message, optional, tag = "4")]
    pub protocol_version: Option<Version>,
    /// The board stops after so many milliseconds without [`Command::WatchdogReset`]; 0 is never.
    #[prost(int32, tag = "5")]
    pub watchdog_timeout: i32,
    /// Its devices.
    #[prost(message, repeated, tag = "6")]
    pub devices: Vec<Device>,
}

/// Types of [`Device`].
pub mod device_type {
    /// Measures.
    pub const SENSOR: i32 = 1;
}

/// Status of a [`Device`].
pub mod device_status {
    /// Can be started.
    pub const READY: i32 = 0;
    /// Sends frames.
    pub const ACTIVE: i32 = 1;
    /// Cannot be used; its message says why.
    pub const ERROR: i32 = 3;
}

/// A device of a board.
#[derive(Clone, PartialEq, Message)]
pub struct Device {
    /// Its number.
    #[prost(int32, tag = "1")]
    pub device_id: i32,
    /// Its name.
    #[prost(string, tag = "2")]
    pub name: String,
    /// What it is.
    #[prost(string, tag = "3")]
    pub description: String,
    /// See [`device_type`].
    #[prost(int32, tag = "4")]
    pub device_type: i32,
    /// What can be set.
    #[prost(message, repeated, tag = "5")]
    pub options: Vec<DeviceOption>,
    /// What it sends and takes.
    #[prost(message, repeated, tag = "6")]
    pub streams: Vec<StreamConfig>,
    /// See [`device_status`].
    #[prost(int32, tag = "7")]
    pub status: i32,
    /// What it says of its status.
    #[prost(string, tag = "8")]
    pub status_message: String,
}

/// What can be set.
#[derive(Clone, PartialEq, Message)]
pub struct DeviceOption {
    /// Its number.
    #[prost(int32, tag = "1")]
    pub option_id: i32,
    /// Its name.
    #[prost(string, tag = "2")]
    pub name: String,
    /// What it does.
    #[prost(string, tag = "3")]
    pub description: String,
    /// Its kind and value. Kinds that a radar does not have are skipped.
    #[prost(oneof = "OptionKind", tags = "7, 8")]
    pub kind: Option<OptionKind>,
}

/// Kinds of option.
#[derive(Clone, PartialEq, Oneof)]
pub enum OptionKind {
    /// One of several items.
    #[prost(message, tag = "7")]
    OneOf(OptionOneOf),
    /// Bytes.
    #[prost(message, tag = "8")]
    Blob(OptionBlob),
}

/// One of several items.
#[derive(Clone, PartialEq, Message)]
pub struct OptionOneOf {
    /// Index at power-up.
    #[prost(int32, tag = "1")]
    pub default_index: i32,
    /// Index now.
    #[prost(int32, tag = "2")]
    pub current_index: i32,
    /// Names.
    #[prost(string, repeated, tag = "3")]
    pub items: Vec<String>,
}

/// Bytes.
#[derive(Clone, PartialEq, Message)]
pub struct OptionBlob {
    /// Value now.
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

/// What a device sends or takes.
#[derive(Clone, PartialEq, Message)]
pub struct StreamConfig {
    /// Its name.
    #[prost(string, tag = "1")]
    pub name: String,
    /// See [`direction`].
    #[prost(int32, tag = "2")]
    pub direction: i32,
    /// See [`data_type`].
    #[prost(int32, tag = "3")]
    pub data_type: i32,
    /// Axes of a frame. Not their order: see the [module](super).
    #[prost(message, repeated, tag = "4")]
    pub shape: Vec<Dimension>,
    /// Frames in a second, rounded to a whole number.
    #[prost(float, tag = "5")]
    pub frequency: f32,
    /// Most frames in a chunk. The radar says 1 and sends more.
    #[prost(int32, tag = "6")]
    pub max_frame_count: i32,
    /// Unit.
    #[prost(string, tag = "7")]
    pub unit: String,
    /// Number of the next frame.
    #[prost(int32, tag = "8")]
    pub current_frame: i32,
    /// Frames that the device has dropped.
    #[prost(int32, tag = "9")]
    pub frames_dropped: i32,
    /// Scale of quantised types.
    #[prost(float, tag = "10")]
    pub scale: f32,
    /// Offset of quantised types.
    #[prost(sint64, tag = "11")]
    pub offset: i64,
    /// Shift of fixed-point types.
    #[prost(int32, tag = "12")]
    pub shift: i32,
}

/// An axis.
#[derive(Clone, PartialEq, Message)]
pub struct Dimension {
    /// Its name.
    #[prost(string, tag = "1")]
    pub name: String,
    /// Its length.
    #[prost(int32, tag = "2")]
    pub size: i32,
    /// Names along it.
    #[prost(string, repeated, tag = "3")]
    pub labels: Vec<String>,
}

impl From<Command> for Request {
    fn from(command: Command) -> Self {
        Request { command: Some(command) }
    }
}

impl Request {
    /// Appends the request as it stands on the line.
    pub fn encode_to(&self, out: &mut Vec<u8>) {
        delimited::encode(self, out);
    }
}

impl From<Answer> for Response {
    fn from(answer: Answer) -> Self {
        Response { answer: Some(answer) }
    }
}

impl Response {
    /// Appends the response as it stands on the line.
    pub fn encode_to(&self, out: &mut Vec<u8>) {
        delimited::encode(self, out);
    }
}
