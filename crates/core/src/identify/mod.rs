//! The inertia of a body from a log of its angular velocity, up to scale.
//!
//! | file | duty |
//! |---|---|
//! | `motion` | a log as sums |
//! | `axes` | least squares of the weak form, principal axes known |
//! | `tensor` | the whole tensor and its principal axes |
//! | `recursive` | the papers' identifiers along the log |
//! | `spread` | the uncertainty of a result, by resampling |
//! | `free` | the stretches of free motion in a log |
//! | `findings` | the conclusions from a log, and its limits |
//!
//! All of it but `free` takes one pass and bounded memory. Pure: no clock, no I/O, no allocation except in `findings` and
//! `free`, which need `std`. Its only input is the angular velocity; the only torque it models is that of the air, −c I ω.

mod axes;
#[cfg(feature = "std")]
mod findings;
#[cfg(feature = "std")]
mod free;
mod motion;
mod recursive;
mod spread;
mod tensor;

pub use axes::AxesFit;
#[cfg(feature = "std")]
pub(crate) use findings::SCALES;
#[cfg(feature = "std")]
pub use findings::{Finding, findings, has_no_scale, wrong_scale};
#[cfg(feature = "std")]
pub use free::free_stretches;
pub use motion::{Motion, MotionSummary, Sample};
pub(crate) use recursive::undamped;
pub use recursive::{RecursiveAxisymmetricIdentifier, RecursiveFit, RecursiveIdentifier};
pub use tensor::TensorFit;

use crate::model::{Inertia, InertiaError};
use nalgebra::Vector3;

/// The largest excess of a moment over the sum of the other two, as a part of it, at which the body counts as flat.
const FLAT: f64 = 0.05;

/// Returns the physically possible moments of inertia nearest to fitted ones. A largest moment that exceeds the sum
/// of the others by less than a twentieth, as for a flat body, is lowered to that sum; the second value is then true.
///
/// ```
/// # extern crate corotate_core as corotate;
/// let (inertia, flattened) = corotate::identify::nearest_body(&[0.07, 0.92, 1.0].into()).unwrap();
/// assert!(flattened && (inertia.moments_kg_m2().z - 0.99).abs() < 1e-12);
/// ```
///
/// # Errors
/// [`InertiaError`] if the moments are too far from those of any body.
pub fn nearest_body(moments: &Vector3<f64>) -> Result<(Inertia, bool), InertiaError> {
    let largest = moments.imax();
    let sum_of_others = moments.sum() - moments[largest];
    let excess = moments[largest] - sum_of_others;
    let mut flat = *moments;
    let flatten = excess > 0.0 && excess < FLAT * moments[largest];
    if flatten {
        flat[largest] = sum_of_others;
    }
    Inertia::new(flat.into()).map(|inertia| (inertia, flatten))
}

#[cfg(test)]
mod tests;
