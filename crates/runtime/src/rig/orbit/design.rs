//! The resolved parameters of an orbit rig.

use super::limits::Limits;
use super::roles::Aim;
use crate::config::{BodyInfo, Rates};
use crate::control::{OrbitGains, OrbitHold};
use crate::model::{CentralField, Noise, OrbitState};
use crate::rig::filter::FilterDesign;
use nalgebra::Vector2;

/// Bodies in a central field, the observer of the first body's velocity, and the law of the driven bodies.
#[derive(Debug, Clone)]
pub struct OrbitRig {
    pub(super) bodies: Vec<BodyInfo>,
    pub(super) field: CentralField,
    pub(super) initial: Vec<OrbitState>,
    pub(super) sensors: Vec<Sensors>,
    pub(super) filter: FilterDesign<2>,
    pub(super) initial_guess: Vector2<f64>,
    /// `None` if no body is driven.
    pub(super) controller: Option<ControllerDesign>,
    pub(super) aim: Aim,
    /// Per body: the disturbance that acts on it, radial and transverse, du/s².
    pub(super) disturbances_du_s2: Vec<Vector2<f64>>,
    pub(super) limits: Limits,
    pub(super) tick_s: f64,
    pub(super) rates: Rates,
}

/// The law of the driven bodies.
#[derive(Debug, Clone, Copy)]
pub(super) struct ControllerDesign {
    pub(super) gains: OrbitGains,
    pub(super) law: OrbitHold,
    /// The number of ticks from a measurement to the tick at which its command acts.
    pub(super) delay_ticks: u64,
    pub(super) predict: bool,
}

/// The errors that a body's sensors add to (r, θ, Vr, Vθ).
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sensors {
    pub(super) noise: Noise<4>,
    pub(super) deviation: [f64; 4],
    pub(super) bias: [f64; 4],
}
