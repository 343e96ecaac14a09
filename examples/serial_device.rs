//! A device behind a serial line: the follower of `config/rigid-pair.toml`, as firmware would implement it.
//!
//! An example for authors of firmware. A device needs this file and the crate `corotate-core`, which builds
//! `no_std`: a [`Body`] in its [`DevicePlant`], the [`Device`] that speaks the protocol for it, a byte stream and a clock. This one simulates its
//! body; a real one reads its gyros in `measure`, sets its torquers in `apply` and `apply_safe`, and leaves `flow` empty.
//! Must not use anything of the library that needs more than `core`, the opening of the line apart.
//!
//! To try it, with a cable or two ends of `socat -d -d pty,raw,echo=0 pty,raw,echo=0`:
//!
//!     corotate run config/rigid-pair.toml --external follower          # prints DIR
//!     cargo run --release --example serial_device -- /dev/pts/1
//!     corotate bridge --serial /dev/pts/2 --role follower --domain DIR

use corotate::model::{Inertia, RigidBody};
use corotate::role::Body;
use corotate::runtime::Line;
use corotate::sample::{RateCommand, RateMeasurement, RateTruth};
use corotate::serial::{Device, DevicePlant, DeviceRole, Hello};
use nalgebra::Vector3;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The name of the device: kind and version.
pub const NAME: &str = "serial_device 1";
const INERTIA_KG_M2: [f64; 3] = [1.0, 2.0, 2.5];
const INITIAL_RATE_RAD_S: [f64; 3] = [-0.3, 0.5, 0.2];
/// All three gyros are there.
const ALL_VALID: u64 = 0b111;
/// The sleep when no byte has arrived. Firmware would wait for the next byte or timer instead.
const NAP: Duration = Duration::from_micros(50);

/// A rigid body with three gyros and three torquers.
pub struct Follower {
    body: RigidBody,
    rate: Vector3<f64>,
    torque: Vector3<f64>,
}

impl Follower {
    /// The follower at its initial state, if that is what the host asks for.
    pub fn asked_for(hello: &Hello<'_>) -> Option<DevicePlant<Self>> {
        let body = RigidBody::new(&Inertia::new(INERTIA_KG_M2).ok()?);
        let follower = Self { body, rate: INITIAL_RATE_RAD_S.into(), torque: Vector3::zeros() };
        (hello.role == "follower").then(|| DevicePlant::new(follower, hello))
    }
}

impl Body for Follower {
    type Truth = RateTruth;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    /// Sets the torquers. What is not finite is no command.
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

    /// Reads the gyros. `status` tells what the actuators do; it is passed on.
    fn measure(&mut self, _tick: u64, status: u64, out: &mut RateMeasurement) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.torque.into();
        (out.valid, out.status) = (ALL_VALID, status);
    }

    /// Only a simulation knows more than it measures. A real device says [`DevicePlant::without_truth`].
    fn truth(&self, status: u64, out: &mut RateTruth) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.torque.into();
        out.status = status;
    }

    /// Moves the body. A real one moves by itself.
    fn flow(&mut self, dt_s: f64) {
        self.rate = self.body.flow(&self.rate, &self.torque, dt_s);
    }
}

/// The device's main loop, until it is switched off or unplugged: bytes in, frames out, and a look at the clock.
pub fn serve<S: DeviceRole, M>(line: &mut Line, device: &mut Device<S, M>, on: &AtomicBool)
where
    M: FnMut(&Hello<'_>) -> Option<S>,
{
    let began = Instant::now();
    let mut bytes = [0; 512];
    while on.load(Ordering::Relaxed) && line.is_open() {
        let now_ns = began.elapsed().as_nanos() as u64;
        let count = line.read(&mut bytes);
        device.receive(&bytes[..count], now_ns, |frame| {
            line.write(frame);
        });
        device.elapse(now_ns);
        line.flush();
        if count == 0 {
            std::thread::sleep(NAP);
        }
    }
}

#[allow(dead_code, reason = "the tests use everything but this")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args_os().nth(1).ok_or("usage: serial_device PATH, as /dev/pts/1 or /dev/ttyS0")?;
    let mut line = Line::open(Path::new(&path), None)?;
    serve(&mut line, &mut Device::new(NAME, Follower::asked_for), &AtomicBool::new(true));
    Ok(())
}
