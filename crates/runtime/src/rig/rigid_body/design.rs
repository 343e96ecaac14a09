//! The parameters of the rigid-body rig, as a scenario resolves to them.

use super::limits::Limits;
use super::plant::Outage;
use super::playback::Playback;
use crate::config::BodyInfo;
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
    /// Per body: initial rate, and inertia over the nominal one.
    pub(super) initial_rates: Vec<Vector3<f64>>,
    /// Per body, how far a fleet's initial rates are spread to either side, and what the draws follow from.
    pub(super) spreads: Vec<Vector3<f64>>,
    pub(super) seed: u64,
    pub(super) inertia_factors: Vec<Vector3<f64>>,
    /// Bit i set: the leader's component i has a gyro.
    pub(super) measured: u64,
    pub(super) outages: Vec<Outage>,
    /// The motion that the leader repeats instead of moving by itself.
    pub(super) playback: Option<Arc<Playback>>,
    /// The component that the observer supplies, 1 to 3.
    pub(super) supplied_axis: Option<usize>,
    pub(super) observer: ObserverDesign,
    pub(super) controller: Option<ControllerDesign>,
    /// Per body, what its gyros add, and of which standard deviation and bias that is.
    pub(super) noise: Vec<Noise<3>>,
    pub(super) deviations_rad_s: Vec<Vector3<f64>>,
    pub(super) biases_rad_s: Vec<Vector3<f64>>,
    pub(super) limits: Limits,
    pub(super) notes: Vec<String>,
    pub(super) tick_s: f64,
    pub(super) actuation_delay_ticks: u64,
    /// What is proven of any follower: they differ in nothing that it knows of.
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
