//! What every sample can do, and the macro that defines one.

use super::field::{Field, FieldKind, field_named};
use super::layout::LayoutName;
use super::stamp::Stamp;
use super::status;

/// Data of any length that a link carries: words of 8 bytes, a stamp at the start.
pub trait Message: core::fmt::Debug + Send + Sync {
    /// Returns the stamp.
    fn stamp(&self) -> &Stamp;
    /// Returns the stamp for writing.
    fn stamp_mut(&mut self) -> &mut Stamp;
    /// Returns all words, those of the stamp first.
    fn words(&self) -> &[u64];
    /// Returns all words for writing.
    fn words_mut(&mut self) -> &mut [u64];

    /// Returns the bytes after the stamp, which the state hash covers.
    #[inline]
    fn content(&self) -> &[u8] {
        &bytemuck::cast_slice(self.words())[size_of::<Stamp>()..]
    }
}

/// A fixed-size sample: plain bytes, a stamp at the start, a versioned name, a table of its fields.
pub trait Sample: Message + bytemuck::Pod + Default + PartialEq {
    /// The name and version of the layout, unique among all samples.
    const TYPE_NAME: &'static str;
    /// The fields after the stamp, in order.
    const FIELDS: &'static [Field];
    /// [`LAYOUT`](Self::LAYOUT) as computed at compile time.
    const LAYOUT_NAME: LayoutName = LayoutName::from_fields(Self::TYPE_NAME, Self::FIELDS);
    /// The type name with a hash of the fields. Links, seat descriptions and devices compare it to detect different
    /// layouts.
    const LAYOUT: &'static str = Self::LAYOUT_NAME.as_str();

    /// The index of the word `status`, counted from the begin of the stamp; `None` if the sample has no such field.
    const STATUS_WORD: Option<usize> = match field_named(Self::FIELDS, "status") {
        Some(index) => Some(Self::FIELDS[index].offset / 8),
        None => None,
    };

    /// Returns the status bits; 0 if the sample has no field `status`.
    #[inline(always)]
    fn status(&self) -> u64 {
        Self::STATUS_WORD.map_or(0, |word| self.words()[word])
    }

    /// Returns true if a sensor has no new value at this tick: at least one field holds an earlier one.
    #[inline(always)]
    fn is_held(&self) -> bool {
        self.status() & status::HELD != 0
    }

    /// Returns true if the field of this name holds an earlier value: its sensor has no new one at this tick.
    /// False for an unknown name.
    #[inline]
    fn holds(&self, name: &str) -> bool {
        self.is_held() && field_named(Self::FIELDS, name).is_some_and(|field| self.status() & status::held(field) != 0)
    }

    /// Returns true if all floating-point fields are finite.
    fn finite(&self) -> bool {
        let words = self.words();
        let mut numbers = Self::FIELDS.iter().filter(|field| field.kind == FieldKind::F64);
        let finite = |field: &Field| {
            words[field.offset / 8..].iter().take(field.count).all(|word| f64::from_bits(*word).is_finite())
        };
        numbers.all(finite)
    }

    /// Copies everything after the stamp from the [`content`](Message::content) of another sample. Returns false and
    /// changes nothing if the lengths differ.
    fn set_content(&mut self, content: &[u8]) -> bool {
        let own = &mut bytemuck::bytes_of_mut(self)[size_of::<Stamp>()..];
        let fits = own.len() == content.len();
        if fits {
            own.copy_from_slice(content);
        }
        fits
    }
}

/// Returns the length of a sample's content, bytes.
pub const fn content_length<S: Sample>() -> usize {
    size_of::<S>() - size_of::<Stamp>()
}

/// Copies every field of `from` into the field of `to` with the same name, type and length, if there is one. The
/// stamps stay.
pub fn copy_fields<A: Sample, B: Sample>(from: &A, to: &mut B) {
    let (source, target) = (bytemuck::bytes_of(from), bytemuck::bytes_of_mut(to));
    for field in A::FIELDS {
        let same = |candidate: &&Field| {
            (candidate.name, candidate.kind, candidate.count) == (field.name, field.kind, field.count)
        };
        if let Some(matching) = B::FIELDS.iter().find(same) {
            let length = 8 * field.count;
            target[matching.offset..][..length].copy_from_slice(&source[field.offset..][..length]);
        }
    }
}

/// Defines a sample: its name, its versioned type name, and its fields of `f64`, `u64` or arrays of them.
///
/// `Pod` rejects padding at compile time. The size is the sum of the fields and a multiple of 8. A field's unit is
/// the last part of its name.
///
/// ```
/// # extern crate corotate_core as corotate;
/// corotate::sample! {
///     /// The sensor readings of a motor.
///     MotorMeasurement = "motor/Measurement/v1" {
///         /// Angular velocity, rad/s.
///         speed_rad_s: f64,
///         /// The bits of [`corotate::sample::status`].
///         status: u64,
///     }
/// }
///
/// use corotate::sample::Sample;
/// assert_eq!(MotorMeasurement::FIELDS[0].name, "speed_rad_s");
/// assert_eq!(size_of::<MotorMeasurement>(), 32 + 16);
/// ```
#[macro_export]
macro_rules! sample {
    ($(#[$doc:meta])* $name:ident = $type_name:literal { $($(#[$field_doc:meta])* $field:ident: $ty:ty,)+ }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, Default, PartialEq, $crate::bytemuck::Pod, $crate::bytemuck::Zeroable)]
        #[bytemuck(crate = "corotate::bytemuck")]
        pub struct $name {
            /// The tick, the sender's generation and the times of the sample.
            pub stamp: $crate::sample::Stamp,
            $($(#[$field_doc])* pub $field: $ty,)+
        }

        impl $crate::sample::Sample for $name {
            const TYPE_NAME: &'static str = $type_name;
            const FIELDS: &'static [$crate::sample::Field] = &[$($crate::sample::Field {
                name: stringify!($field),
                offset: core::mem::offset_of!($name, $field),
                kind: <$ty as $crate::sample::FieldType>::KIND,
                count: <$ty as $crate::sample::FieldType>::COUNT,
            },)+];
        }

        impl $crate::state::Persist for $name {
            #[inline]
            fn persist<W: $crate::state::Words>(&mut self, words: &mut W) {
                let is_number = |word| $crate::sample::is_number(<Self as $crate::sample::Sample>::FIELDS, word);
                words.sample($crate::sample::Message::words_mut(self), is_number);
            }
        }

        impl $crate::sample::Message for $name {
            #[inline]
            fn stamp(&self) -> &$crate::sample::Stamp {
                &self.stamp
            }

            #[inline]
            fn stamp_mut(&mut self) -> &mut $crate::sample::Stamp {
                &mut self.stamp
            }

            #[inline]
            fn words(&self) -> &[u64] {
                $crate::bytemuck::cast_slice(core::slice::from_ref(self))
            }

            #[inline]
            fn words_mut(&mut self) -> &mut [u64] {
                $crate::bytemuck::cast_slice_mut(core::slice::from_mut(self))
            }
        }

        const _: () = {
            let fields = 0 $(+ <$ty as $crate::sample::FieldType>::COUNT)+;
            assert!(size_of::<$name>() == size_of::<$crate::sample::Stamp>() + 8 * fields);
            assert!(align_of::<$name>() == 8 && core::mem::offset_of!($name, stamp) == 0);
        };
    };
}

#[cfg(test)]
mod tests {
    use super::super::{
        Health, OrbitCommand, OrbitEstimate, OrbitMeasurement, OrbitTruth, RateCommand, RateEstimate, RateMeasurement,
        RateTruth, Schedule,
    };
    use super::*;

    fn check<S: Sample>() {
        let mut next = 0;
        for field in Stamp::FIELDS {
            assert_eq!(field.offset, next, "{} follows its predecessor", field.name);
            assert!(S::FIELDS.iter().all(|content| content.name != field.name), "{}: {}", S::TYPE_NAME, field.name);
            next += 8 * field.count;
        }
        assert_eq!(next, size_of::<Stamp>(), "the fields fill the stamp");
        for field in S::FIELDS {
            assert_eq!(field.offset, next, "{}: {} follows its predecessor", S::TYPE_NAME, field.name);
            next += 8 * field.count;
        }
        assert_eq!(next, size_of::<S>(), "{}: the fields fill the sample", S::TYPE_NAME);
        assert_eq!(S::default().content().len() + size_of::<Stamp>(), size_of::<S>());
    }

    #[test]
    fn every_status_bit_has_one_name() {
        for (index, (name, bit)) in status::NAMES.into_iter().enumerate() {
            assert_eq!(bit, 1 << index, "{name}");
        }
    }

    #[test]
    fn set_content_copies_all_or_nothing() {
        let sent = RateCommand { acceleration_rad_s2: [1.0, 2.0, 3.0], ..RateCommand::default() };
        let mut received = RateCommand { stamp: Stamp { tick: 7, ..Stamp::default() }, ..RateCommand::default() };
        assert!(!received.set_content(&sent.content()[1..]) && received.acceleration_rad_s2 == [0.0; 3]);
        assert!(received.set_content(sent.content()));
        assert_eq!((received.acceleration_rad_s2, received.stamp.tick), (sent.acceleration_rad_s2, 7));
        assert_eq!(content_length::<RateCommand>(), sent.content().len());
    }

    /// In every rig each field of the truth is also a field of the measurement, so a device that measures its whole
    /// state reports its truth.
    #[test]
    fn fields_of_equal_name_are_copied() {
        let measured = RateMeasurement {
            omega_rad_s: [1.0, 2.0, 3.0],
            applied_rad_s2: [4.0, 5.0, 6.0],
            valid: 7,
            status: 8,
            ..RateMeasurement::default()
        };
        let mut truth = RateTruth::default();
        copy_fields(&measured, &mut truth);
        assert_eq!((truth.omega_rad_s, truth.applied_rad_s2, truth.status), ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0], 8));
        let measured = OrbitMeasurement { radius_du: 1.0, velocity_du_s: [2.0, 3.0], ..OrbitMeasurement::default() };
        let mut truth = OrbitTruth::default();
        copy_fields(&measured, &mut truth);
        assert_eq!((truth.radius_du, truth.velocity_du_s), (1.0, [2.0, 3.0]));
        let names = |fields: &[Field]| fields.iter().map(|field| field.name).collect::<Vec<_>>();
        for (truth, measured) in
            [(RateTruth::FIELDS, RateMeasurement::FIELDS), (OrbitTruth::FIELDS, OrbitMeasurement::FIELDS)]
        {
            assert!(names(truth).iter().all(|name| names(measured).contains(name)));
        }
    }

    #[test]
    fn the_field_tables_describe_the_bytes() {
        check::<RateTruth>();
        check::<RateMeasurement>();
        check::<RateEstimate>();
        check::<RateCommand>();
        check::<OrbitTruth>();
        check::<OrbitMeasurement>();
        check::<OrbitEstimate>();
        check::<OrbitCommand>();
        check::<Schedule>();
        check::<Health>();
    }
}
