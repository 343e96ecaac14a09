//! The resolved parameters of the rigid-body rig.

use super::limits::Limits;
use super::plant::Outage;
use super::playback::Playback;
use crate::config::{BodyInfo, Rates};
use crate::control::Certificate;
use crate::model::{Inertia, Noise};
use crate::observe::HiddenRate;
use crate::rate::LearnerDesign;
use crate::rig::filter::FilterDesign;
use nalgebra::Vector3;
use std::sync::Arc;

/// A leader, its observer, and the followers with their laws.
#[derive(Debug, Clone)]
pub struct RigidBodyRig {
    pub(super) bodies: Vec<BodyInfo>,
    pub(super) inertia: Inertia,
    /// Per body: the initial rate, rad/s.
    pub(super) initial_rates: Vec<Vector3<f64>>,
    /// Per body: the half-width of a fleet's initial rates, rad/s.
    pub(super) spreads: Vec<Vector3<f64>>,
    /// The seed of all random numbers.
    pub(super) seed: u64,
    /// Per body: the inertia over the nominal one.
    pub(super) inertia_factors: Vec<Vector3<f64>>,
    /// Bit i set: the leader's component i has a gyro.
    pub(super) measured: u64,
    pub(super) outages: Vec<Outage>,
    /// The motion that the leader plays back instead of moving freely.
    pub(super) playback: Option<Arc<Playback>>,
    /// The component that the observer supplies, 1 to 3.
    pub(super) supplied_axis: Option<usize>,
    pub(super) observer: ObserverDesign,
    pub(super) controller: Option<ControllerDesign>,
    /// Per body: the errors of its gyros, and their standard deviation and bias.
    pub(super) noise: Vec<Noise<3>>,
    pub(super) deviations_rad_s: Vec<Vector3<f64>>,
    pub(super) biases_rad_s: Vec<Vector3<f64>>,
    /// Per body: its rate relative to the leader, rad/s, and the disturbance that acts on it, rad/s².
    pub(super) offsets_rad_s: Vec<Vector3<f64>>,
    pub(super) disturbances_rad_s2: Vec<Vector3<f64>>,
    pub(super) limits: Limits,
    pub(super) notes: Vec<String>,
    pub(super) tick_s: f64,
    pub(super) actuation_delay_ticks: u64,
    pub(super) rates: Rates,
    /// The certificate of every follower: followers differ in nothing that it depends on.
    pub(super) certificate: Option<Certificate>,
}

/// The observer's parameters.
#[derive(Debug, Clone)]
pub(super) enum ObserverDesign {
    Hidden { relation: HiddenRate, filter: FilterDesign<1>, guess_rad_s: f64 },
    Learner(LearnerDesign),
}

/// The controller's parameters.
#[derive(Debug, Clone, Copy)]
pub(super) struct ControllerDesign {
    pub(super) gain_per_s: Vector3<f64>,
    pub(super) predict: bool,
    pub(super) learned: bool,
    pub(super) adaptation_gain: f64,
}
