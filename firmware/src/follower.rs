//! The follower, simulated; a real one would read its gyros and set its torquers here.

use crate::pair;
use corotate::model::RigidBody;
use corotate::role::Body;
use corotate::sample::{RateCommand, RateMeasurement, RateTruth};
use corotate::serial::{DevicePlant, Hello};
use nalgebra::Vector3;

/// The name of the device: kind and version.
pub const NAME: &str = "follower 1";
/// The valid bits of all three gyros.
const ALL_VALID: u64 = 0b111;

/// A rigid body with three gyros and three torquers.
pub struct Follower {
    body: RigidBody,
    rate: Vector3<f64>,
    torque: Vector3<f64>,
}

/// Returns the follower at its initial state, if the host asks for it.
pub fn make_role(hello: &Hello<'_>) -> Option<DevicePlant<Follower>> {
    let body = RigidBody::new(&pair::inertia()?);
    let follower = Follower { body, rate: pair::FOLLOWER_RATE_RAD_S.into(), torque: Vector3::zeros() };
    (hello.role == "follower").then(|| DevicePlant::new(follower, hello))
}

impl Body for Follower {
    type Truth = RateTruth;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    fn apply(&mut self, command: &RateCommand) -> bool {
        let torque = Vector3::from(command.acceleration_rad_s2);
        let usable = torque.iter().all(|value| value.is_finite());
        if usable {
            self.torque = torque;
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.torque = Vector3::zeros();
    }

    fn measure(&mut self, _tick: u64, status: u64, out: &mut RateMeasurement) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.torque.into();
        (out.valid, out.status) = (ALL_VALID, status);
    }

    fn truth(&self, status: u64, out: &mut RateTruth) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.torque.into();
        out.status = status;
    }

    fn flow(&mut self, dt_s: f64) {
        self.rate = self.body.flow(&self.rate, &self.torque, dt_s);
    }
}
