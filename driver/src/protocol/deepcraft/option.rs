//! Values of options, in requests and in responses.

#![allow(missing_docs, reason = "names are the firmware's, and say what most fields are")]

use prost::{Message, Oneof};

/// Value of an option.
#[derive(Clone, PartialEq, Message)]
pub struct OptionValue {
    #[prost(int32, tag = "1")]
    pub option_id: i32,
    #[prost(oneof = "Value", tags = "2, 3, 4, 5, 6, 7, 8")]
    pub value: Option<Value>,
}

/// Values by type.
#[derive(Clone, PartialEq, Oneof)]
pub enum Value {
    #[prost(int32, tag = "2")]
    Int(i32),
    #[prost(float, tag = "3")]
    Float(f32),
    #[prost(bool, tag = "4")]
    Bool(bool),
    /// Index into the items of the option.
    #[prost(int32, tag = "5")]
    OneOf(i32),
    #[prost(bytes, tag = "6")]
    Blob(Vec<u8>),
    #[prost(string, tag = "7")]
    Text(String),
    /// A secret.
    #[prost(string, tag = "8")]
    Password(String),
}
