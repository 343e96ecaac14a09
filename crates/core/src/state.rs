//! The state of a state machine, described once, field by field. The same description stores the state in words,
//! restores it, and counts the words.
//!
//! A restarted process continues from the stored state. This module must not allocate, nor know where the words are
//! stored. Values that can be recomputed (caches, parameters) are not state.

use nalgebra::SMatrix;

/// A value whose state outlives its process.
pub trait Persist {
    /// Passes every field of the state through `words`: always the same number of words in the same order, whatever
    /// the values.
    fn persist<W: Words>(&mut self, words: &mut W);
}

/// A visitor of the words of a state, which stores, restores or counts them.
pub trait Words {
    /// Visits one word: stores it, or replaces it by the stored one.
    fn word(&mut self, value: &mut u64);

    /// Visits a number, bit by bit.
    #[inline]
    fn number(&mut self, value: &mut f64) {
        let mut bits = value.to_bits();
        self.word(&mut bits);
        *value = f64::from_bits(bits);
    }

    /// Visits a number that weighs the estimate but is not part of it, such as a covariance.
    #[inline]
    fn weight(&mut self, value: &mut f64) {
        self.number(value);
    }

    /// Visits the words of a sample, of which those are numbers for whose index `is_number` returns true.
    #[inline]
    fn sample(&mut self, words: &mut [u64], _is_number: impl Fn(usize) -> bool) {
        words.iter_mut().for_each(|word| self.word(word));
    }
}

/// Passes the numbers among the words of a sample to `visit`, which may change them.
pub fn each_number(words: &mut [u64], is_number: impl Fn(usize) -> bool, mut visit: impl FnMut(&mut f64)) {
    for (_, word) in words.iter_mut().enumerate().filter(|(index, _)| is_number(*index)) {
        let mut value = f64::from_bits(*word);
        visit(&mut value);
        *word = value.to_bits();
    }
}

/// A visitor of the numbers of a state, which keeps everything else.
pub struct NumberWords<'a>(pub &'a mut dyn FnMut(&mut f64));

impl Words for NumberWords<'_> {
    fn word(&mut self, _value: &mut u64) {}

    fn number(&mut self, value: &mut f64) {
        (self.0)(value);
    }

    fn sample(&mut self, words: &mut [u64], is_number: impl Fn(usize) -> bool) {
        each_number(words, is_number, &mut self.0);
    }
}

/// A visitor that passes the numbers of a state on as [weights](Words::weight).
#[derive(Debug)]
pub struct WeightWords<'a, W>(pub &'a mut W);

impl<W: Words> Words for WeightWords<'_, W> {
    #[inline]
    fn word(&mut self, value: &mut u64) {
        self.0.word(value);
    }

    #[inline]
    fn number(&mut self, value: &mut f64) {
        self.0.weight(value);
    }
}

/// A visitor that counts words and changes nothing.
#[derive(Debug, Default)]
pub struct WordCount(pub usize);

impl Words for WordCount {
    #[inline]
    fn word(&mut self, _value: &mut u64) {
        self.0 += 1;
    }
}

/// Returns the number of words of a state.
///
/// ```
/// # extern crate corotate_core as corotate;
/// let mut state = (1_u64, [2.0, 3.0], Some(4_u64));
/// assert_eq!(corotate::state::length(&mut state), 5);
/// ```
pub fn length(state: &mut impl Persist) -> usize {
    let mut count = WordCount::default();
    state.persist(&mut count);
    count.0
}

/// A visitor that restores a state from its words; missing words are zero.
#[derive(Debug)]
pub struct StoredWords<'a>(pub &'a [u64]);

impl Words for StoredWords<'_> {
    #[inline]
    fn word(&mut self, value: &mut u64) {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        (*value, self.0) = (*first, rest);
    }
}

impl Persist for u64 {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        words.word(self);
    }
}

impl Persist for f64 {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        words.number(self);
    }
}

impl Persist for bool {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        let mut word = u64::from(*self);
        words.word(&mut word);
        *self = word != 0;
    }
}

impl<T: Persist> Persist for [T] {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.iter_mut().for_each(|item| item.persist(words));
    }
}

impl<T: Persist, const N: usize> Persist for [T; N] {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.as_mut_slice().persist(words);
    }
}

impl<const R: usize, const C: usize> Persist for SMatrix<f64, R, C> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.as_mut_slice().persist(words);
    }
}

/// Stores a presence word, then the value or its default.
impl<T: Persist + Default> Persist for Option<T> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        let mut present = self.is_some();
        present.persist(words);
        let mut value = self.take().unwrap_or_default();
        value.persist(words);
        *self = present.then_some(value);
    }
}

macro_rules! persist_tuple {
    ($($item:ident: $index:tt),+) => {
        impl<$($item: Persist),+> Persist for ($($item,)+) {
            #[inline]
            fn persist<W: Words>(&mut self, words: &mut W) {
                $(self.$index.persist(words);)+
            }
        }
    };
}

persist_tuple!(A: 0, B: 1);
persist_tuple!(A: 0, B: 1, C: 2);

/// Implements [`Persist`] for a type by visiting the listed fields.
///
/// ```
/// # extern crate corotate_core as corotate;
/// struct Motor {
///     inertia_kg_m2: f64,
///     speed_rad_s: f64,
/// }
/// // The inertia is a parameter: it comes from the scenario, not from the state.
/// corotate::persist_fields!(Motor, speed_rad_s);
///
/// let mut motor = Motor { inertia_kg_m2: 0.1, speed_rad_s: 3.0 };
/// assert_eq!(corotate::state::length(&mut motor), 1);
/// ```
#[macro_export]
macro_rules! persist_fields {
    ($type:ty, $($field:ident),*) => {
        impl $crate::state::Persist for $type {
            #[inline]
            fn persist<W: $crate::state::Words>(&mut self, words: &mut W) {
                let _ = &words;
                $($crate::state::Persist::persist(&mut self.$field, words);)*
            }
        }
    };
}
pub use crate::persist_fields;

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    struct Store(Vec<u64>);

    impl Words for Store {
        fn word(&mut self, value: &mut u64) {
            self.0.push(*value);
        }
    }

    type State = ((u64, bool), [f64; 2], (Option<Vector3<f64>>, Option<u64>));

    #[test]
    fn a_state_is_restored_bit_by_bit_and_has_the_counted_length() {
        let full = ((u64::MAX, true), [-0.0, f64::INFINITY], (Some(Vector3::new(1.0, 5e-324, -2.5)), Some(7)));
        let empty = ((0, false), [0.0; 2], (None, None));
        for mut state in [full, empty] as [State; 2] {
            let mut store = Store(Vec::new());
            state.persist(&mut store);
            assert_eq!(store.0.len(), length(&mut state), "the length does not depend on the values");
            let mut read: State = if state == full { empty } else { full };
            read.persist(&mut StoredWords(&store.0));
            assert_eq!(read, state);
            assert_eq!(read.1[0].to_bits(), state.1[0].to_bits());
        }
    }
}
