//! Types of protobuf messages, described in protobuf's own format. MCAP stores the description as a channel's schema.

use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto, FileDescriptorProto,
    FileDescriptorSet,
};

const TIMESTAMP_FILE: &str = "google/protobuf/timestamp.proto";

#[derive(Debug)]
pub struct MessageType {
    pub package: &'static str,
    /// Name in its package.
    pub name: &'static str,
    /// Name and type of each field, in the order of their numbers from 1 on. The only messages in fields are timestamps.
    pub fields: &'static [(&'static str, Type)],
    /// Enumeration that the message defines: its name, and its values from 0 on.
    pub enumeration: Option<(&'static str, &'static [&'static str])>,
}

impl MessageType {
    pub fn full_name(&self) -> String {
        format!("{}.{}", self.package, self.name)
    }

    /// Encodes the `FileDescriptorSet` of the type and of all types that it uses.
    pub fn descriptor_set(&self) -> Vec<u8> {
        let enumeration = self.enumeration.map(|(name, values)| EnumDescriptorProto {
            name: Some(name.to_owned()),
            value: (0..).zip(values).map(|(number, name)| enum_value(name, number)).collect(),
            ..EnumDescriptorProto::default()
        });
        let message = DescriptorProto {
            name: Some(self.name.to_owned()),
            field: (1..).zip(self.fields).map(|(number, (name, kind))| self.field(name, number, *kind)).collect(),
            enum_type: enumeration.into_iter().collect(),
            ..DescriptorProto::default()
        };
        let file = FileDescriptorProto {
            name: Some(format!("{}/{}.proto", self.package, self.name)),
            package: Some(self.package.to_owned()),
            dependency: vec![TIMESTAMP_FILE.to_owned()],
            message_type: vec![message],
            syntax: Some("proto3".to_owned()),
            ..FileDescriptorProto::default()
        };
        FileDescriptorSet { file: vec![timestamp_file(), file] }.encode_to_vec()
    }

    fn field(&self, name: &str, number: i32, kind: Type) -> FieldDescriptorProto {
        let type_name = match kind {
            Type::Message => Some(".google.protobuf.Timestamp".to_owned()),
            Type::Enum => self.enumeration.map(|(name, _)| format!(".{}.{name}", self.full_name())),
            _ => None,
        };
        field(name, number, kind, type_name)
    }
}

fn field(name: &str, number: i32, field_type: Type, type_name: Option<String>) -> FieldDescriptorProto {
    FieldDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        label: Some(Label::Optional as i32),
        r#type: Some(field_type as i32),
        type_name,
        ..FieldDescriptorProto::default()
    }
}

fn enum_value(name: &str, number: i32) -> EnumValueDescriptorProto {
    EnumValueDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        ..EnumValueDescriptorProto::default()
    }
}

/// Describes `google.protobuf.Timestamp`.
fn timestamp_file() -> FileDescriptorProto {
    let message = DescriptorProto {
        name: Some("Timestamp".to_owned()),
        field: vec![field("seconds", 1, Type::Int64, None), field("nanos", 2, Type::Int32, None)],
        ..DescriptorProto::default()
    };
    FileDescriptorProto {
        name: Some(TIMESTAMP_FILE.to_owned()),
        package: Some("google.protobuf".to_owned()),
        message_type: vec![message],
        syntax: Some("proto3".to_owned()),
        ..FileDescriptorProto::default()
    }
}
