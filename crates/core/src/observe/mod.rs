//! Observers by the method of invariant relations: one filter, and one relation per unknown.
//!
//! Pure: no clock, no I/O, no allocation, no logging. Must not see the truth, nor remember more than the filter's state.

mod axisymmetric;
mod filter;
mod guarded;
mod hidden_rate;
mod hurwitz;
mod inertia;
mod orbit_velocity;
mod order;
mod second_order;
mod series;

pub use axisymmetric::{Axisymmetric, AxisymmetricError};
pub use filter::{Increment, InvariantFilter, Span, StepAgain};
pub use guarded::{GuardedKalman, RateNoise};
pub use hidden_rate::{Conic, HiddenRate, HiddenRateError, Interval, Observation, RateSample, Regressor};
pub use hurwitz::{Eigenvalues, Hurwitz, HurwitzError};
pub use inertia::{Identification, InertiaRatioError, InertiaRatios, InertiaRelation};
pub use orbit_velocity::{OrbitSample, OrbitVelocity, to_inertial, to_polar};
pub use order::Filter;
pub use second_order::{KalmanFilter, SecondOrderFilter};
