//! Values of options, in requests and in responses.

use prost::{Message, Oneof};

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
