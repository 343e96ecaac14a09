//! The loop of `config/rigid-pair.toml` for firmware: the parameters of that file, and the library's roles created
//! from them.

use corotate::control::{Certificate, Synchronizer};
use corotate::model::{Inertia, RigidBody};
use corotate::observe::{Filter, HiddenRate, InvariantFilter};
use corotate::rate::{HiddenObserver, RateLaw, RateLawDesign};
use nalgebra::{Vector1, Vector3};

const INERTIA_KG_M2: [f64; 3] = [1.0, 2.0, 2.5];
/// The leader's initial rate, rad/s, which determines the certificate's bound.
pub const LEADER_RATE_RAD_S: [f64; 3] = [0.6, -0.4, 0.8];
/// The follower's initial rate, rad/s.
pub const FOLLOWER_RATE_RAD_S: [f64; 3] = [-0.3, 0.5, 0.2];
/// The component without a gyro, 0 to 2.
const HIDDEN: usize = 2;
const DECAY_RATE_PER_S: f64 = 6.0;
const GUESS_RAD_S: f64 = 0.0;
const FLOOR_RAD_S: f64 = 1e-6;
const GAIN_PER_S: f64 = 4.0;
/// The largest gain times period: the sampled loop is unstable from 1 on.
const GAIN_PER_TICK_MAX: f64 = 0.8;
/// The limit printed by `corotate check rigid-pair`.
const ACCELERATION_MAX_RAD_S2: f64 = 115.333_456_311_831_88;

/// Returns the inertia of leader and follower.
pub fn inertia() -> Option<Inertia> {
    Inertia::new(INERTIA_KG_M2).ok()
}

/// Returns the observer of the leader at its initial guess.
pub fn observer() -> Option<HiddenObserver> {
    let coefficients = inertia()?.coefficients();
    let relation = HiddenRate::new(&coefficients, HIDDEN + 1, FLOOR_RAD_S).ok()?;
    let filter = InvariantFilter::new(Vector1::new(DECAY_RATE_PER_S), Vector1::new(GUESS_RAD_S));
    Some(HiddenObserver::new(relation, coefficients, Filter::First(filter)))
}

/// Returns the law of the follower for the period `tick_s`.
pub fn law(tick_s: f64) -> Option<RateLaw> {
    let (inertia, gain) = (inertia()?, Vector3::from([GAIN_PER_S.min(GAIN_PER_TICK_MAX / tick_s); 3]));
    let bound = inertia.rate_bound_rad_s(&LEADER_RATE_RAD_S.into());
    let certificate = Certificate::new(&inertia.coefficients(), HIDDEN + 1, &gain, DECAY_RATE_PER_S, bound, tick_s, 1);
    Some(RateLaw::new(&RateLawDesign {
        law: Synchronizer::new(RigidBody::new(&inertia), gain, 0.0),
        adaptation_gain: 0.0,
        certificate: Some(certificate),
        supplied: HIDDEN,
        learned: false,
        acceleration_max_rad_s2: ACCELERATION_MAX_RAD_S2,
        period_s: tick_s,
        predicted_ticks: 1,
    }))
}
