//! Observers by the method of invariant relations: one relation per unknown, and filters that work with any relation.
//!
//! Pure: no clock, no I/O, no allocation, no logging. An observer must not see the truth, nor store more than its
//! filter's state.

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

pub use axisymmetric::{AxisymmetricError, AxisymmetricRelation};
pub use filter::{Increment, InvariantFilter, Span, StepAgain};
pub use guarded::{GuardedKalman, RateNoise};
pub use hidden_rate::{Conic, HiddenRate, HiddenRateError, Interval, Observation, RateSample, Regressor};
pub use hurwitz::{Eigenvalues, Hurwitz, HurwitzError};
pub use inertia::{Identification, InertiaRatioError, InertiaRatios, InertiaRelation};
pub use orbit_velocity::{OrbitSample, OrbitVelocity, to_inertial, to_polar};
pub use order::Filter;
pub use second_order::{KalmanFilter, SecondOrderFilter};
