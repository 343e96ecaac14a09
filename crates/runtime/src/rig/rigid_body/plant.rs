//! A rigid body with its rate gyros and its torquers.

use super::playback::Playback;
use crate::model::{Noise, RigidBody};
use crate::rate::port;
use crate::role::Body;
use crate::sample::{RateCommand, RateMeasurement, RateTruth};
use crate::state::persist_fields;
use nalgebra::Vector3;
use std::sync::Arc;

/// A time in which a gyro is dead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Outage {
    /// The component, 0 to 2.
    pub component: usize,
    /// The first tick without it.
    pub from_tick: u64,
    /// The first tick with it again.
    pub until_tick: u64,
}

/// A rigid body with its rate gyros and torquers.
#[derive(Debug)]
pub struct RatePlant {
    pub(super) body: RigidBody,
    pub(super) rate: Vector3<f64>,
    /// The commanded acceleration, before the body's own inertia acts on it.
    pub(super) asked: Vector3<f64>,
    /// This body's inertia over the nominal one, per axis. Torques are sized by the nominal one.
    pub(super) inertia_factor: Vector3<f64>,
    /// Bit i set: component i has a gyro.
    pub(super) measured: u64,
    pub(super) noise: Noise<3>,
    pub(super) outages: Vec<Outage>,
    /// The motion that it plays back instead of moving freely, and the time played so far, s.
    pub(super) playback: Option<Arc<Playback>>,
    pub(super) played_s: f64,
    /// The disturbance with the opposite sign, rad/s². Subtracting zero leaves every bit of a number as it is; adding it does not.
    pub(super) resistance_rad_s2: Vector3<f64>,
}

/// Returns a disturbance with the opposite sign; zero is positive.
pub(super) fn resistance(disturbance_rad_s2: &Vector3<f64>) -> Vector3<f64> {
    disturbance_rad_s2.map(|component| 0.0 - component)
}

impl RatePlant {
    #[inline]
    fn acceleration(&self) -> Vector3<f64> {
        self.asked.component_div(&self.inertia_factor)
    }

    /// Bit i set: component i is measured at this tick.
    #[inline]
    fn valid(&self, tick: u64) -> u64 {
        let dead = |outage: &&Outage| (outage.from_tick..outage.until_tick).contains(&tick);
        self.outages.iter().filter(dead).fold(self.measured, |valid, outage| valid & !(1 << outage.component))
    }
}

persist_fields!(RatePlant, rate, asked, noise, played_s);

impl Body for RatePlant {
    type Truth = RateTruth;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    #[inline]
    fn apply(&mut self, command: &RateCommand) -> bool {
        let asked = Vector3::from(command.acceleration_rad_s2);
        let usable = asked.x.is_finite() && asked.y.is_finite() && asked.z.is_finite();
        if usable {
            self.asked = asked;
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.asked = Vector3::zeros();
    }

    #[inline]
    fn truth(&self, status: u64, out: &mut RateTruth) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.acceleration().into();
        out.status = status;
    }

    #[inline]
    fn measure(&mut self, tick: u64, status: u64, out: &mut RateMeasurement) {
        let (valid, seen) = (self.valid(tick), self.rate + self.noise.sample());
        out.omega_rad_s = seen.into();
        for (component, rate) in out.omega_rad_s.iter_mut().enumerate() {
            if valid >> component & 1 == 0 {
                *rate = 0.0;
            }
        }
        out.applied_rad_s2 = self.asked.into();
        out.valid = valid;
        out.status = status;
    }

    #[inline]
    fn flow(&mut self, dt_s: f64) {
        self.rate = match &self.playback {
            Some(playback) => {
                self.played_s += dt_s;
                playback.at(self.played_s)
            }
            None => self.body.flow(&self.rate, &(self.acceleration() - self.resistance_rad_s2), dt_s),
        };
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        if let (port::DISTURBANCE, &[x, y, z]) = (port, values) {
            self.resistance_rad_s2 = resistance(&Vector3::new(x, y, z));
        }
    }
}
