//! The name of a sample's layout: the type name with a hash of the fields.
//!
//! A layout that changes without a new version in its type name has another hash, so that programs built from
//! different sources cannot connect. The hash is computed at compile time. It must not depend on the transport.

use super::field::{Field, FieldKind};
use super::stamp::Stamp;

/// The maximum length of a type name, bytes.
const TYPE_NAME_MAX: usize = 200;
/// The length of `#` and eight hexadecimal digits.
const SUFFIX: usize = 9;

/// A layout name: the type name, `#`, and the hash of the layout.
#[derive(Debug, Clone, Copy)]
pub struct LayoutName {
    bytes: [u8; TYPE_NAME_MAX + SUFFIX],
    length: usize,
}

impl LayoutName {
    /// Creates the name of a fixed-size layout.
    ///
    /// # Panics
    /// If the type name is longer than 200 bytes.
    pub const fn from_fields(type_name: &str, fields: &[Field]) -> Self {
        Self::new(type_name, Hash::new().text(type_name).fields(&Stamp::FIELDS).fields(fields))
    }

    /// Creates the name of a fleet's layout with these vectors.
    ///
    /// # Panics
    /// As [`from_fields`](Self::from_fields).
    pub const fn for_fleet(type_name: &str, vectors: &[&str]) -> Self {
        let mut hash = Hash::new().text(type_name).fields(&Stamp::FIELDS);
        let mut index = 0;
        while index < vectors.len() {
            hash = hash.text(vectors[index]);
            index += 1;
        }
        Self::new(type_name, hash)
    }

    const fn new(type_name: &str, hash: Hash) -> Self {
        let name = type_name.as_bytes();
        assert!(name.len() <= TYPE_NAME_MAX, "a type name has at most 200 bytes");
        let mut bytes = [b'#'; TYPE_NAME_MAX + SUFFIX];
        bytes.split_at_mut(name.len()).0.copy_from_slice(name);
        let folded = (hash.0 >> 32) as u32 ^ hash.0 as u32;
        let mut digit = 0;
        while digit < 8 {
            bytes[name.len() + 1 + digit] = b"0123456789abcdef"[(folded >> (28 - 4 * digit) & 15) as usize];
            digit += 1;
        }
        Self { bytes, length: name.len() + SUFFIX }
    }

    /// Returns the name as text.
    pub const fn as_str(&self) -> &str {
        match core::str::from_utf8(self.bytes.split_at(self.length).0) {
            Ok(text) => text,
            // Unreachable: the bytes come from a `str`.
            Err(_) => "",
        }
    }
}

/// Returns the type name in a layout name; all of the text if it has no hash.
pub fn type_name_of(layout: &str) -> &str {
    layout.split_once('#').map_or(layout, |(type_name, _)| type_name)
}

/// The 64-bit FNV-1a hash.
#[derive(Clone, Copy)]
struct Hash(u64);

impl Hash {
    const fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    const fn byte(self, byte: u8) -> Self {
        Self((self.0 ^ byte as u64).wrapping_mul(0x0000_0100_0000_01b3))
    }

    const fn word(mut self, word: usize) -> Self {
        let bytes = (word as u64).to_le_bytes();
        let mut index = 0;
        while index < bytes.len() {
            self = self.byte(bytes[index]);
            index += 1;
        }
        self
    }

    const fn text(mut self, text: &str) -> Self {
        let bytes = text.as_bytes();
        let mut index = 0;
        while index < bytes.len() {
            self = self.byte(bytes[index]);
            index += 1;
        }
        // 0xff is not a byte of UTF-8, so the boundary between two texts counts too.
        self.byte(0xff)
    }

    const fn fields(mut self, fields: &[Field]) -> Self {
        let mut index = 0;
        while index < fields.len() {
            let Field { name, offset, kind, count } = fields[index];
            let kind = match kind {
                FieldKind::U64 => 0,
                FieldKind::F64 => 1,
            };
            self = self.text(name).word(offset).byte(kind).word(count);
            index += 1;
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn field(name: &'static str, offset: usize, kind: FieldKind, count: usize) -> Field {
        Field { name, offset, kind, count }
    }

    #[test]
    fn different_layouts_have_different_names() {
        use FieldKind::{F64, U64};
        let layouts = [
            LayoutName::from_fields("x/y/v1", &[field("a", 32, F64, 1), field("b", 40, F64, 1)]),
            LayoutName::from_fields("x/y/v1", &[field("b", 32, F64, 1), field("a", 40, F64, 1)]),
            LayoutName::from_fields("x/y/v1", &[field("a", 32, F64, 1), field("b", 40, U64, 1)]),
            LayoutName::from_fields("x/y/v1", &[field("a", 32, F64, 1), field("b", 48, F64, 1)]),
            LayoutName::from_fields("x/y/v1", &[field("a", 32, F64, 1), field("b", 40, F64, 2)]),
            LayoutName::from_fields("x/y/v1", &[field("ab", 32, F64, 1), field("", 40, F64, 1)]),
            LayoutName::from_fields("x/y/v2", &[field("a", 32, F64, 1), field("b", 40, F64, 1)]),
            LayoutName::for_fleet("x/y/v1", &["a", "b"]),
            LayoutName::for_fleet("x/y/v1", &["b", "a"]),
        ];
        let names: std::collections::BTreeSet<&str> = layouts.iter().map(LayoutName::as_str).collect();
        assert_eq!(names.len(), layouts.len(), "{names:?}");
        assert!(names.iter().all(|name| type_name_of(name).len() == 6 && name.len() == 6 + SUFFIX), "{names:?}");
    }

    /// The sources of devices and foreign programs contain the names of our layouts.
    #[test]
    fn the_names_of_shipped_layouts_do_not_change() {
        use super::super::{RateCommand, RateMeasurement, RateTruth, Sample};
        assert_eq!(RateCommand::LAYOUT, "corotate/rigid-body/command/v2#ff8ce508");
        assert_eq!(RateMeasurement::LAYOUT, "corotate/rigid-body/measurement/v1#bcfd8b41");
        assert_eq!(RateTruth::LAYOUT, "corotate/rigid-body/truth/v1#6b083b5d");
    }
}
