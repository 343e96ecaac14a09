//! The fields of a sample: their names, types and places.

/// The type of a field's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldKind {
    /// Unsigned 64-bit integer.
    U64,
    /// IEEE 754 double.
    F64,
}

/// The location of one field in a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// The name; the unit is its last part.
    pub name: &'static str,
    /// The offset from the start of the sample, bytes.
    pub offset: usize,
    /// The type of the elements.
    pub kind: FieldKind,
    /// The number of elements: 1 for a scalar.
    pub count: usize,
}

/// A type permitted as a sample's field: 8-byte elements, so that natural alignment leaves no padding.
pub trait FieldType {
    /// The type of the elements.
    const KIND: FieldKind;
    /// The number of elements.
    const COUNT: usize;
}

impl FieldType for u64 {
    const KIND: FieldKind = FieldKind::U64;
    const COUNT: usize = 1;
}

impl FieldType for f64 {
    const KIND: FieldKind = FieldKind::F64;
    const COUNT: usize = 1;
}

impl<T: FieldType, const N: usize> FieldType for [T; N] {
    const KIND: FieldKind = T::KIND;
    const COUNT: usize = N * T::COUNT;
}

/// Returns the index of the field with this name. Usable at compile time.
pub const fn field_named(fields: &[Field], name: &str) -> Option<usize> {
    let mut index = 0;
    while index < fields.len() {
        if same_name(fields[index].name, name) {
            return Some(index);
        }
        index += 1;
    }
    None
}

/// Returns true if two names are equal. Usable at compile time.
pub const fn same_name(a: &str, b: &str) -> bool {
    let (a, b, mut index) = (a.as_bytes(), b.as_bytes(), 0);
    while index < a.len() && index < b.len() && a[index] == b[index] {
        index += 1;
    }
    index == a.len() && index == b.len()
}

/// Returns true if a word of a sample, counted from the begin of its stamp, is part of a field of `f64`.
pub fn is_number(fields: &[Field], word: usize) -> bool {
    let covers = |field: &&Field| (field.offset / 8..field.offset / 8 + field.count).contains(&word);
    fields.iter().find(covers).is_some_and(|field| field.kind == FieldKind::F64)
}
