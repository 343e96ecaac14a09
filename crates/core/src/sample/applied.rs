//! A sample of a body together with the command that acts on the body.
//!
//! The layout is derived at compile time from those of the two samples. This module must not know when a command acts.

use super::field::{Field, FieldKind};
use super::message::{Message, Sample};
use super::stamp::Stamp;
use crate::state::{Persist, Words};
use bytemuck::{Pod, Zeroable};
use core::ops::Deref;

/// The most fields of such a sample, and the longest name of a field or a type, bytes.
const FIELDS_MAX: usize = 64;
const NAME_MAX: usize = 190;
/// The name of each of the command's fields follows this.
const PREFIX: &str = "applied_";
/// The words of the command's stamp, of which the first is its tick.
const COMMAND_STAMP: [&str; 2] = ["applied_tick", "applied_spare"];

/// A sample of a body with the command that acts on the body, as [`Actuated`](crate::role::Actuated) measures it.
///
/// It has the fields of the sample, then `applied_tick`, the tick of the command, and the fields of the command with the prefix
/// `applied_`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Applied<S, C> {
    /// The sample.
    pub sample: S,
    /// The command that acts from this tick on, until the next sample. Of its stamp only the tick is set.
    pub applied: C,
}

// SAFETY: two samples of which all bit patterns are valid.
#[allow(unsafe_code, reason = "the derive macro does not take type parameters")]
unsafe impl<S: Sample, C: Sample> Zeroable for Applied<S, C> {}

// SAFETY: `Sample` is `Pod`, and `PLAIN` refuses at compile time a pair that would leave a gap between or after the two.
#[allow(unsafe_code, reason = "the derive macro does not take type parameters")]
unsafe impl<S: Sample, C: Sample> Pod for Applied<S, C> {}

impl<S, C> Deref for Applied<S, C> {
    type Target = S;

    fn deref(&self) -> &S {
        &self.sample
    }
}

impl<S: Sample, C: Sample> Applied<S, C> {
    /// Refuses samples that would leave a gap.
    const PLAIN: () = {
        assert!(align_of::<S>() == 8 && align_of::<C>() == 8, "a sample is aligned to 8 bytes");
        assert!(size_of::<Self>() == size_of::<S>() + size_of::<C>());
    };
    const TYPE: Name = Name::new(&[S::TYPE_NAME, "/with/", C::TYPE_NAME]);
    const NAMES: [Name; FIELDS_MAX] = {
        let (mut names, mut index) = ([Name::new(&[]); FIELDS_MAX], 0);
        while index < C::FIELDS.len() {
            names[index] = Name::new(&[PREFIX, C::FIELDS[index].name]);
            index += 1;
        }
        names
    };
    const TABLE: [Field; FIELDS_MAX] = {
        let () = Self::PLAIN;
        assert!(Self::COUNT <= FIELDS_MAX, "a sample with a command has at most 64 fields");
        let names: &'static [Name; FIELDS_MAX] = &Self::NAMES;
        let mut table = [Field { name: "", offset: 0, kind: FieldKind::U64, count: 0 }; FIELDS_MAX];
        let (mut place, mut index) = (0, 0);
        while index < S::FIELDS.len() {
            table[place] = S::FIELDS[index];
            (place, index) = (place + 1, index + 1);
        }
        let begin = size_of::<S>();
        let [tick, spare] = COMMAND_STAMP;
        table[place] = Field { name: tick, offset: begin, kind: FieldKind::U64, count: 1 };
        table[place + 1] =
            Field { name: spare, offset: begin + 8, kind: FieldKind::U64, count: size_of::<Stamp>() / 8 - 1 };
        (place, index) = (place + 2, 0);
        while index < C::FIELDS.len() {
            let Field { offset, kind, count, .. } = C::FIELDS[index];
            table[place] = Field { name: names[index].as_str(), offset: begin + offset, kind, count };
            (place, index) = (place + 1, index + 1);
        }
        table
    };
    const COUNT: usize = S::FIELDS.len() + COMMAND_STAMP.len() + C::FIELDS.len();
}

impl<S: Sample, C: Sample> Sample for Applied<S, C> {
    const TYPE_NAME: &'static str = {
        let name: &'static Name = &Self::TYPE;
        name.as_str()
    };
    const FIELDS: &'static [Field] = {
        let table: &'static [Field; FIELDS_MAX] = &Self::TABLE;
        table.split_at(Self::COUNT).0
    };
}

impl<S: Sample, C: Sample> Message for Applied<S, C> {
    #[inline]
    fn stamp(&self) -> &Stamp {
        self.sample.stamp()
    }

    #[inline]
    fn stamp_mut(&mut self) -> &mut Stamp {
        self.sample.stamp_mut()
    }

    #[inline]
    fn words(&self) -> &[u64] {
        let () = Self::PLAIN;
        bytemuck::cast_slice(core::slice::from_ref(self))
    }

    #[inline]
    fn words_mut(&mut self) -> &mut [u64] {
        let () = Self::PLAIN;
        bytemuck::cast_slice_mut(core::slice::from_mut(self))
    }
}

impl<S: Persist, C: Persist> Persist for Applied<S, C> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.sample.persist(words);
        self.applied.persist(words);
    }
}

/// A name that is put together at compile time.
#[derive(Clone, Copy)]
struct Name {
    bytes: [u8; NAME_MAX],
    length: usize,
}

impl Name {
    const fn new(parts: &[&str]) -> Self {
        let (mut bytes, mut length, mut part) = ([0; NAME_MAX], 0, 0);
        while part < parts.len() {
            let text = parts[part].as_bytes();
            assert!(length + text.len() <= NAME_MAX, "the names of a sample and its command are too long together");
            let mut index = 0;
            while index < text.len() {
                bytes[length] = text[index];
                (length, index) = (length + 1, index + 1);
            }
            part += 1;
        }
        Self { bytes, length }
    }

    const fn as_str(&self) -> &str {
        match core::str::from_utf8(self.bytes.split_at(self.length).0) {
            Ok(text) => text,
            // Unreachable: the bytes come from texts.
            Err(_) => "",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{RateCommand, RateMeasurement};

    #[test]
    fn the_layout_is_that_of_both_samples() {
        type Both = Applied<RateMeasurement, RateCommand>;
        assert_eq!(Both::TYPE_NAME, "corotate/rigid-body/measurement/v1/with/corotate/rigid-body/command/v2");
        let (own, rest) = Both::FIELDS.split_at(RateMeasurement::FIELDS.len());
        assert_eq!(own, RateMeasurement::FIELDS);
        let names: Vec<&str> = rest.iter().map(|field| field.name).collect();
        assert_eq!(names[..3], ["applied_tick", "applied_spare", "applied_acceleration_rad_s2"]);
        let end = Both::FIELDS.iter().fold(size_of::<Stamp>(), |end, field| {
            assert_eq!(field.offset, end, "{}", field.name);
            end + 8 * field.count
        });
        assert_eq!(end, size_of::<Both>());
    }
}
