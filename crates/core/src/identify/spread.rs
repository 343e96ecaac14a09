//! The uncertainty of a result by the delete-a-group jackknife: each group of pieces is left out once, and the
//! results are compared.
//!
//! It needs no model of the noise, and includes errors of the model as far as they differ between pieces.

use super::motion::{Motion, Sums};
use nalgebra::SVector;

/// The least number of groups.
const FEWEST: usize = 4;

/// Computes the standard deviations of `result` over the motion; `None` with too few pieces, or if a part alone has
/// no result.
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
            wheel: total.wheel,
        })
    };
    // Computed twice, to avoid storing every result.
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
