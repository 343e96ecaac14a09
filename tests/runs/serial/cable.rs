//! A cable of two ptys that may be faulty, unplugged and plugged in again.

use super::NAP;
use crate::common::{Bench, await_some};
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// One end of a cable: a pty whose near end replaces a serial port. It stays raw and open while unused.
pub struct Port {
    far: OwnedFd,
    _near: OwnedFd,
    pub path: PathBuf,
}

impl Port {
    pub fn new() -> Self {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&far).unwrap();
        unlockpt(&far).unwrap();
        let path = PathBuf::from(ptsname(&far, Vec::new()).unwrap().to_str().unwrap());
        let near = open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).unwrap();
        let mut settings = tcgetattr(&near).unwrap();
        settings.make_raw();
        tcsetattr(&near, OptionalActions::Now, &settings).unwrap();
        fcntl_setfl(&far, fcntl_getfl(&far).unwrap() | OFlags::NONBLOCK).unwrap();
        Self { far, _near: near, path }
    }

    fn read(&self, bytes: &mut [u8]) -> usize {
        rustix::io::read(&self.far, bytes).unwrap_or(0)
    }

    /// Writes bytes; a full line loses them, like a real one.
    pub fn write(&self, bytes: &[u8]) {
        let _ = rustix::io::write(&self.far, bytes);
    }
}

/// Faults of a cable: probabilities per byte, and the longest delay of the bytes of one read.
#[derive(Clone, Copy)]
pub struct Faults {
    drop: f64,
    corrupt: f64,
    garbage: f64,
    delay: Duration,
    /// True if reads are split into random pieces.
    pieces: bool,
}

pub const CLEAN: Faults = Faults { drop: 0.0, corrupt: 0.0, garbage: 0.0, delay: Duration::ZERO, pieces: false };

pub const FAULTY: Faults =
    Faults { drop: 3e-4, corrupt: 3e-4, garbage: 3e-4, delay: Duration::from_millis(2), pieces: true };

/// A cable between the bridge's port and the device's.
pub struct Cable {
    pub host: Arc<Port>,
    pub device: Arc<Port>,
    on: Arc<AtomicBool>,
    /// Number of bytes that reached the device's end.
    carried: Arc<AtomicUsize>,
    pumps: Vec<JoinHandle<()>>,
}

impl Cable {
    pub fn new(faults: Faults) -> Self {
        let (host, device) = (Arc::new(Port::new()), Arc::new(Port::new()));
        let on = Arc::new(AtomicBool::new(true));
        let carried = Arc::new(AtomicUsize::new(0));
        let pump = |from: &Arc<Port>, to: &Arc<Port>, seed, carried: Option<&Arc<AtomicUsize>>| {
            let (from, to, on, carried) = (from.clone(), to.clone(), on.clone(), carried.cloned());
            std::thread::spawn(move || pump(&from, &to, faults, seed, &on, carried.as_deref()))
        };
        let pumps = vec![pump(&host, &device, 1, Some(&carried)), pump(&device, &host, 2, None)];
        Self { host, device, on, carried, pumps }
    }

    /// Waits until about a hundred ticks have crossed the cable.
    pub fn await_ticks(&self) {
        await_some(|| (self.carried.load(Ordering::Relaxed) > 10_000).then_some(()));
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
        self.pumps.drain(..).for_each(|pump| pump.join().unwrap());
    }
}

fn pump(from: &Port, to: &Port, faults: Faults, seed: u64, on: &AtomicBool, carried: Option<&AtomicUsize>) {
    let (mut random, mut bytes) = (Pcg64::seed_from_u64(seed), [0; 4096]);
    let mut uniform = move || random.next_u64() as f64 / u64::MAX as f64;
    while on.load(Ordering::Relaxed) {
        let count = from.read(&mut bytes);
        if count == 0 {
            std::thread::sleep(NAP);
            continue;
        }
        if let Some(carried) = carried {
            carried.fetch_add(count, Ordering::Relaxed);
        }
        let mut out = Vec::new();
        for &byte in &bytes[..count] {
            match uniform() {
                draw if draw < faults.drop => {}
                draw if draw < faults.drop + faults.corrupt => out.push(byte ^ (1 << ((8.0 * uniform()) as u32 % 8))),
                draw if draw < faults.drop + faults.corrupt + faults.garbage => {
                    out.push(byte);
                    out.extend((0..(40.0 * uniform()) as usize).map(|_| (256.0 * uniform()) as u8));
                }
                _ => out.push(byte),
            }
        }
        std::thread::sleep(faults.delay.mul_f64(uniform()));
        let mut rest = &out[..];
        while faults.pieces && rest.len() > 1 {
            let (piece, more) = rest.split_at(1 + (uniform() * (rest.len() - 1) as f64) as usize);
            to.write(piece);
            std::thread::sleep(NAP);
            rest = more;
        }
        to.write(rest);
    }
}

/// A cable whose ports have names that disappear when it is unplugged, like those of a USB adapter. The names of ptys are not used,
/// because the next pty takes them at once.
pub struct Adapter {
    names: [PathBuf; 2],
    pub cable: Cable,
}

impl Adapter {
    pub fn plug_in(bench: &Bench) -> Self {
        let (cable, names) = (Cable::new(CLEAN), ["tty-host", "tty-device"].map(|name| bench.path(name)));
        for (name, port) in names.iter().zip([&cable.host, &cable.device]) {
            std::os::unix::fs::symlink(&port.path, name).unwrap();
        }
        Self { names, cable }
    }
}

impl Drop for Adapter {
    fn drop(&mut self) {
        self.names.iter().for_each(|name| std::fs::remove_file(name).unwrap());
    }
}
