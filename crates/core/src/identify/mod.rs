//! The inertia of a body from a log of its angular velocity, up to scale.
//!
//! | file | duty |
//! |---|---|
//! | `motion` | a log as sums |
//! | `axes` | least squares of the weak form, principal axes known |
//! | `tensor` | the whole tensor and its principal axes |
//! | `recursive` | the papers' identifiers along the log |
//! | `spread` | how sure a result is, by resampling |
//! | `findings` | what the log tells of the body, and what it cannot tell |
//!
//! All of it takes one pass, and memory that does not grow. Pure: no clock, no I/O, no allocation but for `findings`, which
//! needs `std`. Must not be told more than the angular velocity: a torque is at best the air's, −c I ω.

mod axes;
#[cfg(feature = "std")]
mod findings;
mod motion;
mod recursive;
mod spread;
mod tensor;

pub use axes::AxesFit;
#[cfg(feature = "std")]
pub use findings::{Finding, findings};
pub use motion::{Motion, MotionSummary, Sample};
pub(crate) use recursive::freed;
pub use recursive::{Recursive, RecursiveAxisymmetric, RecursiveFit};
pub use tensor::TensorFit;

use crate::model::{Inertia, InertiaError};
use nalgebra::Vector3;

/// How far beyond what a body can have the largest moment may be found, as a part of it, for the body to count as flat.
const FLAT: f64 = 0.05;

/// Moments of inertia that a body can have, from fitted ones. A largest moment that exceeds the sum of the others by less
/// than a twentieth, as it may be found of a flat body, is lowered to that sum; whether it was is told.
///
/// ```
/// # extern crate corotate_core as corotate;
/// let (inertia, flattened) = corotate::identify::nearest_body(&[0.07, 0.92, 1.0].into()).unwrap();
/// assert!(flattened && (inertia.moments_kg_m2().z - 0.99).abs() < 1e-12);
/// ```
///
/// # Errors
/// [`InertiaError`] if they are too far from any body's.
pub fn nearest_body(moments: &Vector3<f64>) -> Result<(Inertia, bool), InertiaError> {
    let largest = moments.imax();
    let others = moments.sum() - moments[largest];
    let excess = moments[largest] - others;
    let mut flat = *moments;
    let flatten = excess > 0.0 && excess < FLAT * moments[largest];
    if flatten {
        flat[largest] = others;
    }
    Inertia::new(flat.into()).map(|inertia| (inertia, flatten))
}

#[cfg(test)]
mod tests;
