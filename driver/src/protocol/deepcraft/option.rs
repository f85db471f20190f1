//! Values of options, in requests and in responses.

#![allow(missing_docs, reason = "names are the firmware's, and say what most fields are")]

use prost::{Message, Oneof};

/// Value of an option.
#[derive(Clone, PartialEq, Message)]
pub struct OptionValue {
    #[prost(int32, tag = "1")]
    pub option_id: i32,
    /// Value of the option. Types that a radar's options do not have are skipped.
    #[prost(oneof = "Value", tags = "5, 6")]
    pub value: Option<Value>,
}

/// Values by type.
#[derive(Clone, PartialEq, Oneof)]
pub enum Value {
    /// Index into the items of the option.
    #[prost(int32, tag = "5")]
    OneOf(i32),
    #[prost(bytes, tag = "6")]
    Blob(Vec<u8>),
}
