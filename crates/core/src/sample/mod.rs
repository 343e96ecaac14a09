//! What travels between roles: fixed-size plain data, the same bytes in memory, on the wire and in a recording.
//!
//! Every sample is a `repr(C)` struct of `u64` and `f64` without padding, begins with a [`Stamp`], and carries a versioned
//! type name. Its bytes are the little-endian CDR body of the message with the same fields. A change of layout changes the
//! version in the name. Must not know how samples travel.

#[cfg(feature = "std")]
mod definition;
mod fleet;
mod layout;
mod orbit;
mod rigid;
mod run;

#[cfg(feature = "std")]
pub use definition::{CDR_HEADER, Column, Layout, MESSAGE_ENCODING, SCHEMA_ENCODING, frame, topic_of};
pub use fleet::{
    CommandLayout, FleetCommand, FleetLayout, FleetMeasurement, FleetSample, FleetTruth, MeasurementLayout, TruthLayout,
};
pub use layout::{LayoutName, type_name_of};
pub use orbit::{OrbitCommand, OrbitEstimate, OrbitMeasurement, OrbitTruth};
pub use rigid::{RateCommand, RateEstimate, RateMeasurement, RateTruth};
pub use run::{Health, Phase, RoleState, Schedule};

/// What every sample begins with.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Stamp {
    /// The tick k whose instant T_k this sample belongs to.
    pub tick: u64,
    /// How often the sender has started in this run, from 1. 0 marks a warm-up sample, which no role uses.
    pub generation: u64,
    /// When the tick was due at the body whose measurement began this chain, ns on the monotonic clock. Copied along.
    pub origin_ns: u64,
    /// When the sample was handed to the link, ns on the monotonic clock.
    pub sent_ns: u64,
}

impl Stamp {
    /// The fields, in order.
    pub const FIELDS: [Field; 4] = [
        Self::field("tick", core::mem::offset_of!(Self, tick)),
        Self::field("generation", core::mem::offset_of!(Self, generation)),
        Self::field("origin_ns", core::mem::offset_of!(Self, origin_ns)),
        Self::field("sent_ns", core::mem::offset_of!(Self, sent_ns)),
    ];

    /// Whether it is of a warm-up sample. A sample of a later tick is none, though a fault has broken its generation.
    #[inline]
    pub fn is_warm_up(&self) -> bool {
        (self.tick, self.generation) == (0, 0)
    }

    const fn field(name: &'static str, offset: usize) -> Field {
        Field { name, offset, kind: FieldKind::U64, count: 1 }
    }
}

/// Set in a stamp's generation: of this tick there is no sample, and there will be none. A void.
///
/// Where everybody waits for inputs (lockstep, one thread), a sample that is missing would stop the loop; a void stands in
/// its place. Readers count it and treat the tick as they treat a sample that was lost. Real time needs none.
pub const NO_SAMPLE: u64 = 1 << 63;

/// The type of one field's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldKind {
    /// Unsigned 64-bit integer.
    U64,
    /// IEEE 754 double.
    F64,
}

/// Where one field lies within a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// Its name; the unit is its last part.
    pub name: &'static str,
    /// Bytes from the start of the sample.
    pub offset: usize,
    /// The type of its elements.
    pub kind: FieldKind,
    /// How many elements: 1 for a scalar.
    pub count: usize,
}

/// A type that a sample may have as a field: 8-byte elements, so that natural alignment leaves no padding.
pub trait FieldType {
    /// The type of the elements.
    const KIND: FieldKind;
    /// How many.
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

/// What travels on a link, whatever its length: words of 8 bytes, a stamp at the start.
pub trait Message: core::fmt::Debug + Send + Sync {
    /// The stamp.
    fn stamp(&self) -> &Stamp;
    /// The stamp, to be written.
    fn stamp_mut(&mut self) -> &mut Stamp;
    /// All of it.
    fn words(&self) -> &[u64];
    /// All of it, to be written.
    fn words_mut(&mut self) -> &mut [u64];

    /// The bytes of everything but the stamp: what the state hash covers.
    #[inline]
    fn content(&self) -> &[u8] {
        &bytemuck::cast_slice(self.words())[size_of::<Stamp>()..]
    }
}

/// A sample: plain bytes, a stamp at the start, a versioned name, a table of its fields.
pub trait Sample: Message + bytemuck::Pod + Default + PartialEq {
    /// Name and version of the layout, unique among all samples.
    const TYPE_NAME: &'static str;
    /// The fields after the stamp, in order.
    const FIELDS: &'static [Field];
    /// [`LAYOUT`](Self::LAYOUT), as the compiler makes it.
    const LAYOUT_NAME: LayoutName = LayoutName::from_fields(Self::TYPE_NAME, Self::FIELDS);
    /// The type name with a hash of the fields: by it the ends of links, seats and devices know that they mean the same.
    const LAYOUT: &'static str = Self::LAYOUT_NAME.as_str();

    /// Whether all of its numbers are numbers, and finite.
    fn finite(&self) -> bool {
        let words = self.words();
        let mut numbers = Self::FIELDS.iter().filter(|field| field.kind == FieldKind::F64);
        let finite = |field: &Field| {
            words[field.offset / 8..].iter().take(field.count).all(|word| f64::from_bits(*word).is_finite())
        };
        numbers.all(finite)
    }

    /// Takes over everything but the stamp from the bytes that [`content`](Message::content) gave elsewhere; false, and
    /// nothing changed, if they are not as many.
    fn set_content(&mut self, content: &[u8]) -> bool {
        let own = &mut bytemuck::bytes_of_mut(self)[size_of::<Stamp>()..];
        let fits = own.len() == content.len();
        if fits {
            own.copy_from_slice(content);
        }
        fits
    }
}

/// Bytes of a sample's content.
pub const fn content_length<S: Sample>() -> usize {
    size_of::<S>() - size_of::<Stamp>()
}

/// Copies every field of `from` into the field of the same name and kind in `to`, if there is one; the stamps stay.
pub fn copy_fields<A: Sample, B: Sample>(from: &A, to: &mut B) {
    let (source, target) = (bytemuck::bytes_of(from), bytemuck::bytes_of_mut(to));
    for field in A::FIELDS {
        let same = |other: &&Field| (other.name, other.kind, other.count) == (field.name, field.kind, field.count);
        if let Some(other) = B::FIELDS.iter().find(same) {
            let length = 8 * field.count;
            target[other.offset..][..length].copy_from_slice(&source[field.offset..][..length]);
        }
    }
}

/// Defines a sample: its name, its type name with a version, and its fields, of `f64`, `u64` or arrays of them.
///
/// `Pod` refuses padding at compile time; the size is the sum of the fields and a multiple of 8. A field's unit is the last
/// part of its name.
///
/// ```
/// # extern crate corotate_core as corotate;
/// corotate::sample! {
///     /// What a motor's sensors report.
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
            /// When, in which life of the sender, and for which tick.
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
                $crate::sample::Message::words_mut(self).iter_mut().for_each(|word| words.word(word));
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
pub use crate::sample;

/// Bits of a sample's status word.
pub mod status {
    /// The plant had no command for this tick in time and holds the last one.
    pub const HOLDING: u64 = 1 << 0;
    /// The plant applies its safe command.
    pub const SAFE: u64 = 1 << 1;
    /// The estimate is the configured guess: nothing has been observed yet.
    pub const INITIAL: u64 = 1 << 2;
    /// The motion did not reveal the unknown since the last sample: the estimate moved by the model alone.
    pub const UNOBSERVABLE: u64 = 1 << 3;
    /// The measurement lacked a component that the observer needs, or was not finite: the estimate went on by the model
    /// alone, or is the previous one where the model is being learned.
    pub const UNUSABLE: u64 = 1 << 4;
    /// The observer learns the body's inertia from all components.
    pub const LEARNING: u64 = 1 << 5;
    /// A component that used to be measured is supplied by the observer.
    pub const AXIS_LOST: u64 = 1 << 6;
    /// The component was lost before the inertia had been learned: bounded, but not to be trusted.
    pub const DEGRADED: u64 = 1 << 7;
    /// The motion does not excite the identifier.
    pub const NOT_EXCITED: u64 = 1 << 8;
    /// The body met an end of its model (it hit something, or left for good) and is frozen at its last good state.
    pub const FAULT: u64 = 1 << 9;
    /// The input of this tick was there and was not believed: not finite, of a wrong life of its sender, or physically
    /// impossible. It is treated as missing.
    pub const REJECTED: u64 = 1 << 10;

    /// Every bit with its name.
    pub const NAMES: [(&str, u64); 11] = [
        ("holding", HOLDING),
        ("safe", SAFE),
        ("initial", INITIAL),
        ("unobservable", UNOBSERVABLE),
        ("unusable", UNUSABLE),
        ("learning", LEARNING),
        ("axis_lost", AXIS_LOST),
        ("degraded", DEGRADED),
        ("not_excited", NOT_EXCITED),
        ("fault", FAULT),
        ("rejected", REJECTED),
    ];
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<S: Sample>() {
        let mut next = 0;
        for field in Stamp::FIELDS {
            assert_eq!(field.offset, next, "{} follows its predecessor", field.name);
            assert!(S::FIELDS.iter().all(|other| other.name != field.name), "{}: {}", S::TYPE_NAME, field.name);
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
    fn content_goes_from_sample_to_sample_whole_or_not_at_all() {
        let sent = RateCommand { acceleration_rad_s2: [1.0, 2.0, 3.0], ..RateCommand::default() };
        let mut received = RateCommand { stamp: Stamp { tick: 7, ..Stamp::default() }, ..RateCommand::default() };
        assert!(!received.set_content(&sent.content()[1..]) && received.acceleration_rad_s2 == [0.0; 3]);
        assert!(received.set_content(sent.content()));
        assert_eq!((received.acceleration_rad_s2, received.stamp.tick), (sent.acceleration_rad_s2, 7));
        assert_eq!(content_length::<RateCommand>(), sent.content().len());
    }

    /// What a device measures completely is its truth, in every rig: each field of the truth is one of the measurement.
    #[test]
    fn fields_of_one_name_are_copied() {
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
