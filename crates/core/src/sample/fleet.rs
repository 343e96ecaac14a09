//! Samples of a fleet: many bodies of the rig `rigid-body` in one process. Their length depends on the number of
//! bodies.
//!
//! A sample is a header followed by vectors of three components as structures of arrays: component 1 of every body,
//! component 2 of every body, component 3 of every body. Every element is a word of 8 bytes, so the bytes equal those
//! of a message with arrays of that fixed length.

use super::field::{Field, FieldKind};
use super::layout::LayoutName;
use super::message::Message;
use super::stamp::Stamp;
use bytemuck::TransparentWrapper;
use core::fmt;
use core::marker::PhantomData;

/// The number of components of a vector.
const AXES: usize = 3;
/// The number of words before the arrays: the stamp, the number of bodies, the status.
const HEADER: usize = size_of::<Stamp>() / size_of::<u64>() + 2;
const BODIES: usize = HEADER - 2;
const STATUS: usize = HEADER - 1;

type Words = [u64];

/// The contents of a fleet's sample after its header.
pub trait FleetLayout: fmt::Debug + Send + Sync + 'static {
    /// The name and version of the layout, unique among all samples.
    const TYPE_NAME: &'static str;
    /// The names of the vectors, in order; the unit is the last part of each.
    const VECTORS: &'static [&'static str];
    /// [`LAYOUT`](Self::LAYOUT) as computed at compile time.
    const LAYOUT_NAME: LayoutName = LayoutName::for_fleet(Self::TYPE_NAME, Self::VECTORS);
    /// The type name with a hash of the vectors.
    const LAYOUT: &'static str = Self::LAYOUT_NAME.as_str();
}

/// A sample of a fleet, used in place.
#[repr(transparent)]
#[derive(TransparentWrapper)]
#[transparent(Words)]
pub struct FleetSample<L: FleetLayout> {
    layout: PhantomData<L>,
    words: Words,
}

/// The true states of all bodies. For recording and scoring only: no controller opens it.
///
/// `omega_rad_s`: angular velocities, rad/s; `applied_rad_s2`: control accelerations held from this tick on, rad/s².
pub type FleetTruth = FleetSample<TruthLayout>;
/// The readings of the sensors and actuators of all bodies at a tick; every component is measured.
///
/// `omega_rad_s`: angular velocities, rad/s; `applied_rad_s2`: control accelerations held from this tick on, rad/s².
pub type FleetMeasurement = FleetSample<MeasurementLayout>;
/// The commands of all actuators from the next tick on.
///
/// `acceleration_rad_s2`: control accelerations (torque over inertia), rad/s².
pub type FleetCommand = FleetSample<CommandLayout>;

macro_rules! layout {
    ($name:ident = $type_name:literal [$($vector:literal),+]) => {
        #[doc = concat!("The layout `", $type_name, "`.")]
        #[derive(Debug)]
        pub enum $name {}

        impl FleetLayout for $name {
            const TYPE_NAME: &'static str = $type_name;
            const VECTORS: &'static [&'static str] = &[$($vector),+];
        }
    };
}

layout!(TruthLayout = "corotate/rigid-fleet/truth/v1" ["omega_rad_s", "applied_rad_s2"]);
layout!(MeasurementLayout = "corotate/rigid-fleet/measurement/v1" ["omega_rad_s", "applied_rad_s2"]);
layout!(CommandLayout = "corotate/rigid-fleet/command/v1"["acceleration_rad_s2"]);

impl<L: FleetLayout> FleetSample<L> {
    /// Returns the length of a sample of `bodies` bodies, words.
    pub const fn length(bodies: usize) -> usize {
        HEADER + L::VECTORS.len() * AXES * bodies
    }

    /// Returns the fields after the stamp, in order, of a sample of `bodies` bodies.
    pub fn fields(bodies: usize) -> impl Iterator<Item = Field> {
        let word = size_of::<u64>();
        let header = [("bodies", BODIES), ("status", STATUS)].into_iter();
        let header = header.map(move |(name, at)| Field { name, offset: at * word, kind: FieldKind::U64, count: 1 });
        let vector = move |(index, name): (usize, &&'static str)| Field {
            name,
            offset: (HEADER + index * AXES * bodies) * word,
            kind: FieldKind::F64,
            count: AXES * bodies,
        };
        header.chain(L::VECTORS.iter().enumerate().map(vector))
    }

    /// Returns the words as a sample.
    ///
    /// # Panics
    /// If the length is not the [`length`](Self::length) of a sample.
    #[inline]
    pub fn over(words: &[u64]) -> &Self {
        assert!(Self::fits(words.len()), "a fleet's sample is a header and whole vectors");
        Self::wrap_ref(words)
    }

    /// Returns the words as a mutable sample.
    ///
    /// # Panics
    /// As [`over`](Self::over).
    #[inline]
    pub fn over_mut(words: &mut [u64]) -> &mut Self {
        assert!(Self::fits(words.len()), "a fleet's sample is a header and whole vectors");
        Self::wrap_mut(words)
    }

    #[inline]
    fn fits(length: usize) -> bool {
        length.checked_sub(HEADER).is_some_and(|values| values.is_multiple_of(L::VECTORS.len() * AXES))
    }

    /// Returns the number of bodies that the sample has room for.
    #[inline]
    pub fn bodies(&self) -> usize {
        (self.words.len() - HEADER) / (L::VECTORS.len() * AXES)
    }

    /// Returns the number of bodies in the header, as its sender wrote it.
    #[inline]
    pub fn declared_bodies(&self) -> u64 {
        self.words[BODIES]
    }

    /// Returns the bits of [`status`](super::status), which apply to all bodies.
    #[inline]
    pub fn status(&self) -> u64 {
        self.words[STATUS]
    }

    /// Writes the status and the number of bodies into the header.
    #[inline]
    pub fn set_status(&mut self, status: u64) {
        self.words[BODIES] = self.bodies() as u64;
        self.words[STATUS] = status;
    }

    /// Returns the three components of the vector with this index in the layout, each for every body.
    #[inline]
    pub fn vector(&self, index: usize) -> [&[f64]; AXES] {
        let bodies = self.bodies();
        let values: &[f64] = bytemuck::cast_slice(&self.words[HEADER + index * AXES * bodies..][..AXES * bodies]);
        let (first, rest) = values.split_at(bodies);
        let (second, third) = rest.split_at(bodies);
        [first, second, third]
    }

    /// Returns the mutable components of the vector with this index in the layout, each for every body.
    #[inline]
    pub fn vector_mut(&mut self, index: usize) -> [&mut [f64]; AXES] {
        let bodies = self.bodies();
        let words = &mut self.words[HEADER + index * AXES * bodies..][..AXES * bodies];
        let (first, rest) = bytemuck::cast_slice_mut(words).split_at_mut(bodies);
        let (second, third) = rest.split_at_mut(bodies);
        [first, second, third]
    }
}

impl<L: FleetLayout> Message for FleetSample<L> {
    #[inline]
    fn stamp(&self) -> &Stamp {
        bytemuck::from_bytes(bytemuck::cast_slice(&self.words[..BODIES]))
    }

    #[inline]
    fn stamp_mut(&mut self) -> &mut Stamp {
        bytemuck::from_bytes_mut(bytemuck::cast_slice_mut(&mut self.words[..BODIES]))
    }

    #[inline]
    fn words(&self) -> &[u64] {
        &self.words
    }

    #[inline]
    fn words_mut(&mut self) -> &mut [u64] {
        &mut self.words
    }
}

impl<L: FleetLayout> fmt::Debug for FleetSample<L> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = L::TYPE_NAME;
        f.debug_struct(name).field("stamp", self.stamp()).field("bodies", &self.bodies()).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<L: FleetLayout>(bodies: usize) {
        let mut next = size_of::<Stamp>();
        for field in FleetSample::<L>::fields(bodies) {
            assert_eq!(field.offset, next, "{}: {} follows its predecessor", L::TYPE_NAME, field.name);
            next += 8 * field.count;
        }
        assert_eq!(next, 8 * FleetSample::<L>::length(bodies), "{}: the fields fill the sample", L::TYPE_NAME);
    }

    #[test]
    fn the_fields_fill_the_sample() {
        for bodies in [1, 3, 1000] {
            check::<TruthLayout>(bodies);
            check::<MeasurementLayout>(bodies);
            check::<CommandLayout>(bodies);
        }
    }

    #[test]
    fn every_value_is_at_the_offset_of_its_field() {
        let mut words = [0; FleetTruth::length(5)];
        let sample = FleetTruth::over_mut(&mut words);
        sample.stamp_mut().tick = 7;
        sample.set_status(9);
        for vector in 0..2 {
            for (axis, values) in sample.vector_mut(vector).into_iter().enumerate() {
                let value = |body: usize| (100 * vector + 10 * axis + body) as f64;
                values.iter_mut().enumerate().for_each(|(body, slot)| *slot = value(body));
            }
        }
        assert_eq!((sample.stamp().tick, sample.status(), sample.declared_bodies()), (7, 9, 5));
        let second = FleetTruth::fields(5).find(|field| field.name == "applied_rad_s2").unwrap();
        assert_eq!(f64::from_bits(words[second.offset / 8 + 5 + 2]), 112.0, "vector 1, axis 1, body 2");
        let sample = FleetTruth::over(&words);
        assert_eq!(sample.vector(0)[2], [20.0, 21.0, 22.0, 23.0, 24.0]);
    }

    #[test]
    fn only_whole_vectors_fit() {
        let lengths: Vec<usize> = (0..20).filter(|length| FleetTruth::fits(*length)).collect();
        assert_eq!(lengths, [6, 12, 18]);
    }
}
