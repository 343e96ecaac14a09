//! What a state machine remembers from one step to the next, described once, field by field: the same description writes
//! the state to words, reads it back, and counts the words.
//!
//! A process that continues the work of another begins with the other's state. Must not allocate, nor know where the words
//! are kept. What can be computed again from what is kept (a cache, a parameter) is not state.

use nalgebra::SMatrix;

/// Something whose state outlives the process that it runs in.
pub trait Persist {
    /// Passes every field of the state through `words`: always as many, always in the same order, whatever their values.
    fn persist<W: Words>(&mut self, words: &mut W);
}

/// Where a state goes, or comes from.
pub trait Words {
    /// Passes one word: it is kept, or replaced by the one that was kept.
    fn word(&mut self, value: &mut u64);

    /// Passes a number, bit by bit.
    #[inline]
    fn number(&mut self, value: &mut f64) {
        let mut bits = value.to_bits();
        self.word(&mut bits);
        *value = f64::from_bits(bits);
    }

    /// Passes a number that weighs what is estimated and is no part of it: a covariance.
    #[inline]
    fn weight(&mut self, value: &mut f64) {
        self.number(value);
    }
}

/// Passes the numbers of a state as [weights](Words::weight).
#[derive(Debug)]
pub struct Weights<'a, W>(pub &'a mut W);

impl<W: Words> Words for Weights<'_, W> {
    #[inline]
    fn word(&mut self, value: &mut u64) {
        self.0.word(value);
    }

    #[inline]
    fn number(&mut self, value: &mut f64) {
        self.0.weight(value);
    }
}

/// Counts words and changes nothing.
#[derive(Debug, Default)]
pub struct Count(pub usize);

impl Words for Count {
    #[inline]
    fn word(&mut self, _value: &mut u64) {
        self.0 += 1;
    }
}

/// How many words a state takes.
///
/// ```
/// # extern crate corotate_core as corotate;
/// let mut state = (1_u64, [2.0, 3.0], Some(4_u64));
/// assert_eq!(corotate::state::length(&mut state), 5);
/// ```
pub fn length(state: &mut impl Persist) -> usize {
    let mut count = Count::default();
    state.persist(&mut count);
    count.0
}

/// Reads a state back from the words that it was written to; zeros follow the last.
#[derive(Debug)]
pub struct Restore<'a>(pub &'a [u64]);

impl Words for Restore<'_> {
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

/// Whether it is there, and then itself, or its default.
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

/// Implements [`Persist`] for a type by the fields that are its state.
///
/// ```
/// # extern crate corotate_core as corotate;
/// struct Motor {
///     inertia_kg_m2: f64,
///     speed_rad_s: f64,
/// }
/// // The inertia is a parameter: a successor has it from the scenario.
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
    fn what_was_kept_is_read_back_bit_by_bit_and_takes_as_many_words_as_are_counted() {
        let full = ((u64::MAX, true), [-0.0, f64::INFINITY], (Some(Vector3::new(1.0, 5e-324, -2.5)), Some(7)));
        let empty = ((0, false), [0.0; 2], (None, None));
        for mut state in [full, empty] as [State; 2] {
            let mut store = Store(Vec::new());
            state.persist(&mut store);
            assert_eq!(store.0.len(), length(&mut state), "as long whatever is in it");
            let mut read: State = if state == full { empty } else { full };
            read.persist(&mut Restore(&store.0));
            assert_eq!(read, state);
            assert_eq!(read.1[0].to_bits(), state.1[0].to_bits());
        }
    }
}
