//! Devices in threads: the reference device, any role of any rig, and scripts.

use super::NAP;
use super::serial_device::{Follower, NAME, serve};
use corotate::rig::Rig;
use corotate::runtime::Line;
use corotate::scenario::Scenario;
use corotate::serial::{
    Decoder, Device, DeviceController, DeviceFlightComputer, DeviceObserver, DevicePlant, DeviceRole, Hello,
};
use corotate::with_shipped_rig;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// A device that runs until it is dropped.
pub struct Powered {
    on: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Powered {
    /// Runs `life` in a thread until its flag is cleared.
    pub fn new(life: impl FnOnce(&AtomicBool) + Send + 'static) -> Self {
        let on = Arc::new(AtomicBool::new(true));
        let flag = on.clone();
        Self { on, thread: Some(std::thread::spawn(move || life(&flag))) }
    }

    /// Starts the reference device, `examples/serial_device.rs`.
    pub fn reference(path: &Path) -> Self {
        let path = path.to_owned();
        Self::new(move |on| live(&path, &mut Device::new(NAME, Follower::asked_for), on))
    }

    /// Starts a device with any role of any rig.
    pub fn of_rig(path: &Path, scenario: Scenario, role: &'static str) -> Self {
        let path = path.to_owned();
        Self::new(move |on| with_shipped_rig!(scenario.rig, rig => any_role(rig, role, &path, on)))
    }
}

impl Drop for Powered {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
        let result = self.thread.take().map(JoinHandle::join);
        assert!(std::thread::panicking() || matches!(result, Some(Ok(()))), "the device failed");
    }
}

/// Serves the role of this name, or the body otherwise; controllers have one driven body.
fn any_role<R: Rig>(rig: &R, role: &str, path: &Path, on: &AtomicBool) {
    match role {
        "observer" => role_of(role, path, on, |hello| DeviceObserver::new(rig.estimator(), hello)),
        "controller" => role_of(role, path, on, |hello| DeviceController::new([rig.law(1)], hello)),
        "observer controller" => {
            role_of(role, path, on, |hello| DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello));
        }
        _ => role_of(role, path, on, |hello| DevicePlant::new(rig.body(1), hello)),
    }
}

fn role_of<S: DeviceRole>(role: &str, path: &Path, on: &AtomicBool, mut start: impl FnMut(&Hello<'_>) -> S) {
    let seat = |hello: &Hello<'_>| {
        assert_eq!(hello.role, role);
        Some(start(hello))
    };
    live(path, &mut Device::new("any", seat), on);
}

/// Serves a device, which keeps its state while its line is unplugged and plugged in again.
fn live<S: DeviceRole, M: FnMut(&Hello<'_>) -> Option<S>>(path: &Path, device: &mut Device<S, M>, on: &AtomicBool) {
    while on.load(Ordering::Relaxed) {
        match Line::open(path, None) {
            Ok(mut line) => serve(&mut line, device, on),
            Err(_) => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}

/// Starts a device that answers every frame with the bytes that `reply` returns for its payload.
pub fn scripted(path: &Path, reply: fn(&[u8]) -> Vec<u8>) -> Powered {
    let path = path.to_owned();
    Powered::new(move |on| {
        let (mut line, mut decoder, mut bytes) = (Line::open(&path, None).unwrap(), Decoder::default(), [0; 512]);
        while on.load(Ordering::Relaxed) {
            let count = line.read(&mut bytes);
            decoder.feed(&bytes[..count], |payload| {
                line.write(&reply(payload));
            });
            std::thread::sleep(NAP);
        }
    })
}
