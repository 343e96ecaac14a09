//! How sure a result is: each group of pieces is left out once, and the results are compared (the delete-a-group jackknife).
//!
//! It needs no model of the noise, and tells of errors of the model too, as far as they differ between pieces.

use super::motion::{Motion, Sums};
use nalgebra::SVector;

/// With fewer groups nothing is said.
const FEWEST: usize = 4;

/// Standard deviations of what `result` makes of the motion; none with too few pieces, or where a part alone has no result.
pub(super) fn over_groups<const N: usize>(
    motion: &Motion,
    result: impl Fn(&Sums) -> Option<SVector<f64, N>>,
) -> Option<SVector<f64, N>> {
    let total = motion.total();
    let filled = || motion.groups.iter().filter(|group| group.pieces > 0);
    let count = filled().count();
    if count < FEWEST {
        return None;
    }
    let without = |group: &Sums| {
        result(&Sums {
            scatter: total.scatter - group.scatter,
            samples: total.samples - group.samples,
            pieces: total.pieces - group.pieces,
        })
    };
    // Twice, instead of a place for every result.
    let mut mean = SVector::zeros();
    for group in filled() {
        mean += without(group)? / count as f64;
    }
    let mut squares = SVector::zeros();
    for group in filled() {
        let apart = without(group)? - mean;
        squares += apart.component_mul(&apart);
    }
    let scale = (count - 1) as f64 / count as f64;
    Some(squares.map(|square| libm::sqrt(square * scale)))
}
