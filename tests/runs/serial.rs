//! Devices behind a serial line: the bridge as a process, the device in a thread, and between them a cable of two ptys that may be
//! faulty, unplugged and plugged in again.

#[path = "../../examples/serial_device.rs"]
pub(super) mod serial_device;

use crate::common::{Bench, Done, Running, await_some, shipped};
use corotate::rig::Rig;
use corotate::runtime::Line;
use corotate::sample::{RateCommand, Sample};
use corotate::scenario::Scenario;
use corotate::serial::{
    Decoder, Device, DeviceController, DeviceFlightComputer, DeviceObserver, DevicePlant, DeviceRole, Hello, MAX_FRAME,
    MAX_PAYLOAD, Message, Reason, Refuse, Welcome, encode, parse, write,
};
use corotate::with_shipped_rig;
use libc::{SIGINT, SIGKILL};
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use serde_json::Value;
use serial_device::{Follower, NAME, serve};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

const NAP: Duration = Duration::from_micros(50);

/// One end of a cable: a pty whose near end replaces a serial port. It stays raw and open while unused.
struct Port {
    far: OwnedFd,
    _near: OwnedFd,
    path: PathBuf,
}

impl Port {
    fn new() -> Self {
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
    fn write(&self, bytes: &[u8]) {
        let _ = rustix::io::write(&self.far, bytes);
    }
}

/// Faults of a cable: probabilities per byte, and the longest delay of the bytes of one read.
#[derive(Clone, Copy)]
struct Faults {
    drop: f64,
    corrupt: f64,
    garbage: f64,
    delay: Duration,
    /// True if reads are split into random pieces.
    pieces: bool,
}

const CLEAN: Faults = Faults { drop: 0.0, corrupt: 0.0, garbage: 0.0, delay: Duration::ZERO, pieces: false };

/// A cable between the bridge's port and the device's.
struct Cable {
    host: Arc<Port>,
    device: Arc<Port>,
    on: Arc<AtomicBool>,
    /// Number of bytes that reached the device's end.
    carried: Arc<AtomicUsize>,
    pumps: Vec<JoinHandle<()>>,
}

impl Cable {
    fn new(faults: Faults) -> Self {
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
    fn await_ticks(&self) {
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

/// A device that runs until it is dropped.
struct Powered {
    on: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Powered {
    /// Runs `life` in a thread until its flag is cleared.
    fn new(life: impl FnOnce(&AtomicBool) + Send + 'static) -> Self {
        let on = Arc::new(AtomicBool::new(true));
        let flag = on.clone();
        Self { on, thread: Some(std::thread::spawn(move || life(&flag))) }
    }

    /// Starts the reference device, `examples/serial_device.rs`.
    fn reference(path: &Path) -> Self {
        let path = path.to_owned();
        Self::new(move |on| live(&path, &mut Device::new(NAME, Follower::asked_for), on))
    }

    /// Starts a device with any role of any rig.
    fn of_rig(path: &Path, scenario: Scenario, role: &'static str) -> Self {
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
    let check_role = |hello: &Hello<'_>| assert_eq!(hello.role, role);
    match role {
        "observer" => live(
            path,
            &mut Device::new("any", |hello| {
                check_role(hello);
                Some(DeviceObserver::new(rig.estimator(), hello))
            }),
            on,
        ),
        "controller" => live(
            path,
            &mut Device::new("any", |hello| {
                check_role(hello);
                Some(DeviceController::new([rig.law(1)], hello))
            }),
            on,
        ),
        "observer controller" => live(
            path,
            &mut Device::new("any", |hello| {
                check_role(hello);
                Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello))
            }),
            on,
        ),
        _ => live(
            path,
            &mut Device::new("any", |hello| {
                check_role(hello);
                Some(DevicePlant::new(rig.body(1), hello))
            }),
            on,
        ),
    }
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

/// Starts a run with an external follower. Returns it with its domain.
pub(super) fn start(bench: &Bench, file: &Path, arguments: &[&str]) -> (Running, PathBuf) {
    start_without(bench, file, &["follower"], arguments)
}

/// Starts a run with external roles. Returns it with its domain.
fn start_without(bench: &Bench, file: &Path, roles: &[&str], arguments: &[&str]) -> (Running, PathBuf) {
    let common = ["run", file.to_str().unwrap(), "--json", "--out", "out", "--overwrite"];
    let external: Vec<&str> = roles.iter().flat_map(|role| ["--external", *role]).collect();
    let running = bench.start(&[&common[..], &external, arguments].concat());
    bench.await_role("leader");
    (running, bench.domains().remove(0))
}

fn bridge(bench: &Bench, path: &Path, domain: &Path, arguments: &[&str]) -> Running {
    bridge_of(bench, "follower", path, domain, arguments)
}

fn bridge_of(bench: &Bench, roles: &str, path: &Path, domain: &Path, arguments: &[&str]) -> Running {
    let (path, domain) = (path.to_str().unwrap(), domain.to_str().unwrap());
    let common = ["bridge", "--serial", path, "--role", roles, "--domain", domain];
    bench.start(&[&common[..], arguments].concat())
}

/// Runs a shipped scenario with the device at `path` as the follower.
fn run_with(bench: &Bench, scenario: &str, path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start(bench, &shipped(scenario), arguments);
    let bridge = bridge(bench, path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    let sent = number(&run.json()["lines"]["follower"]["frames_sent"]);
    assert!(bridge.stderr.contains(&format!("{sent} frames")), "{sent}: {bridge:?}");
    bench.assert_clean(&[domain]);
    summary_of(&run, &bridge)
}

/// Returns the summary of a run. On a loaded machine the device may be absent for a while; run and bridge then both report it.
fn summary_of(run: &Done, bridge: &Done) -> Value {
    let summary = run.json();
    assert_eq!(run.code, Some(0), "{run:?}");
    let absent = incidents(&summary, "continued").iter().any(|incident| incident["replaced_by"].is_null());
    assert_eq!(bridge.code, Some(if absent { 4 } else { 0 }), "{bridge:?} {run:?}");
    assert!(!absent || summary["clock"] == "realtime", "{summary:#}");
    summary
}

/// Returns the incidents of a run with the given action.
fn incidents(summary: &Value, action: &str) -> Vec<Value> {
    let all = summary["incidents"].as_array().unwrap();
    all.iter().filter(|incident| incident["action"] == action).cloned().collect()
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is not a count"))
}

/// Returns the first metric at the end of a run.
fn sync_error(summary: &Value) -> f64 {
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    summary["score"]["metrics"][0]["last"].as_f64().unwrap()
}

const LOCKSTEP: [&str; 6] = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "10"];
/// On a loaded machine a bridge may send no heartbeat for seconds.
const PATIENT: &str = "--set=supervision.heartbeat_timeout_s=60";
const REALTIME: [&str; 9] =
    ["--clock", "realtime", "--tick-hz", "100", "--duration", "8", "--set", "accept={}", PATIENT];

#[test]
fn in_lockstep_a_device_gives_the_bits_of_the_built_in_follower() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let device = Powered::reference(&cable.device.path);
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    let built_in = bench.summary("rigid-pair", &LOCKSTEP);
    assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"]);
    assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"]);
    let line = &with_device["lines"]["follower"];
    assert_eq!((number(&line["restarts"]), number(&line["crc_errors"]), number(&line["malformed"])), (0, 0, 0));
    assert!(number(&line["frames_received"]) >= 1002, "{line}");
    drop(device);
}

/// The bridge holds the fields of a device's measurement as a simulated body's.
#[test]
fn in_lockstep_a_device_with_a_slower_sensor_gives_the_same_bits() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let sensor = r#"sensor=[{body="follower",field="omega_rad_s",every_ticks=4,phase_ticks=1}]"#;
    let slow = [&LOCKSTEP[..], &["--set", sensor, "--set", "accept={}"]].concat();
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &slow);
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &slow)["state"]["hash"]);
    assert_ne!(with_device["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
}

/// Requests are repeated until they are answered, and no tick is executed twice.
#[test]
fn in_lockstep_a_faulty_line_gives_the_same_bits() {
    let bench = Bench::new();
    let faults = Faults { drop: 3e-4, corrupt: 3e-4, garbage: 3e-4, delay: Duration::from_millis(2), pieces: true };
    let cable = Cable::new(faults);
    let _device = Powered::reference(&cable.device.path);
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
    let line = &with_device["lines"]["follower"];
    println!("{line}");
    assert!(number(&line["repeats"]) > 20 && number(&line["crc_errors"]) > 5 && number(&line["resyncs"]) > 5, "{line}");
    assert_eq!(number(&line["unanswered"]), 0, "{line}");
}

#[test]
fn a_device_may_be_the_body_of_any_rig() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let arguments = ["--clock", "lockstep", "--duration", "5", "--set", "accept={}"];
    let scenario = Scenario::load(&shipped("orbit-rendezvous"), &[]).unwrap();
    let scenario = Scenario::parse(&scenario.to_toml(), "test", &["duration_s=5".to_owned(), "accept={}".to_owned()]);
    let _device = Powered::of_rig(&cable.device.path, scenario.unwrap(), "follower");
    let with_device = run_with(&bench, "orbit-rendezvous", &cable.host.path, &arguments);
    assert_eq!(with_device["state"]["hash"], bench.summary("orbit-rendezvous", &arguments)["state"]["hash"]);
}

/// The roles that a device can have besides a body, as on the command line and as in the greeting.
const COMPUTERS: [(&[&str], &str); 3] = [
    (&["observer"], "observer"),
    (&["controller"], "controller"),
    (&["observer", "controller"], "observer controller"),
];

/// Runs a shipped scenario with a device that has the given roles.
fn run_roles(bench: &Bench, scenario: &str, roles: &[&str], path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start_without(bench, &shipped(scenario), roles, arguments);
    let bridge = bridge_of(bench, &roles.join(","), path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    bench.assert_clean(&[domain]);
    summary_of(&run, &bridge)
}

fn short(scenario: &str, arguments: &[&str]) -> Scenario {
    let overrides: Vec<String> = arguments.iter().map(|argument| (*argument).to_owned()).collect();
    Scenario::parse(&std::fs::read_to_string(shipped(scenario)).unwrap(), "test", &overrides).unwrap()
}

/// Processor in the loop: the plants are simulated.
#[test]
fn in_lockstep_a_device_may_be_observer_or_controller_or_both_in_any_rig() {
    let bench = Bench::new();
    for name in ["rigid-pair", "orbit-rendezvous"] {
        let arguments = ["--clock", "lockstep", "--duration", "1", "--set", "accept={}"];
        let built_in = bench.summary(name, &arguments);
        for (roles, role) in COMPUTERS {
            let cable = Cable::new(CLEAN);
            let _device = Powered::of_rig(&cable.device.path, short(name, &["duration_s=1", "accept={}"]), role);
            let with_device = run_roles(&bench, name, roles, &cable.host.path, &arguments);
            assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"], "{name}: {role}");
            assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"], "{name}: {role}");
            // All roles of a line share one handshake. A late device is greeted again after 8 requests, 7 of them repeated.
            let line = &with_device["lines"][roles[0]];
            let (handshakes, repeats) = (number(&line["handshakes"]), number(&line["repeats"]));
            assert!(handshakes >= 1 && 7 * (handshakes - 1) <= repeats, "{line:#}");
        }
    }
}

/// Dropped and out-of-range measurements are injected as well.
#[test]
fn in_lockstep_a_flight_computer_on_a_faulty_line_gives_the_same_bits() {
    let bench = Bench::new();
    let faults = Faults { drop: 3e-4, corrupt: 3e-4, garbage: 3e-4, delay: Duration::from_millis(2), pieces: true };
    let cable = Cable::new(faults);
    let lost = "fault=[{kind=\"drop\", role=\"leader\", from_tick=100, ticks=3}, {kind=\"out-of-range\", value=1e3, role=\"leader\", \
                from_tick=300, ticks=2}, {kind=\"drop\", role=\"follower\", from_tick=200, ticks=30}]";
    let arguments = [&LOCKSTEP[..], &["--set", "accept={}", "--set", lost]].concat();
    let scenario = short("rigid-pair", &["duration_s=10", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&cable.device.path, scenario, "observer controller");
    let with_device = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &arguments);
    let built_in = bench.summary("rigid-pair", &arguments);
    assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"]);
    assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"]);
    assert!(number(&built_in["books"]["injected_faults"]) >= 33, "{}", built_in["books"]);
    let line = &with_device["lines"]["observer"];
    println!("{line}");
    assert!(number(&line["repeats"]) > 20 && number(&line["crc_errors"]) > 5, "{line}");
}

#[test]
fn in_real_time_a_flight_computer_synchronises() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let scenario = short("rigid-pair", &["duration_s=8", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&cable.device.path, scenario, "observer controller");
    let summary = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &REALTIME);
    let (error, roles) = (sync_error(&summary), &summary["books"]["roles"]);
    println!("{error:e} rad/s; {roles}; line {}", summary["lines"]["observer"]);
    for role in ["observer", "controller"] {
        assert_eq!(number(&roles[role]["executed"]) + number(&roles[role]["missed"]), 801);
    }
    let limit = if number(&summary["books"]["missed_ticks"]) < 200 { 1e-6 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let serial = summary["latencies"].as_array().unwrap().iter().find(|stage| stage["stage"] == "serial").unwrap();
    assert_eq!(
        (&serial["role"], number(&serial["count"]) - number(&serial["missed"])),
        (&Value::from("observer"), number(&roles["observer"]["executed"]))
    );
}

#[test]
fn a_flight_computer_that_pauses_misses_the_ticks_of_its_pause() {
    const PAUSE: Duration = Duration::from_millis(300);
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let (path, scenario) =
        (cable.device.path.clone(), short("rigid-pair", &["duration_s=30", "tick_hz=100", "accept={}"]));
    let _device = Powered::new(move |on| {
        with_shipped_rig!(scenario.rig, rig => {
            let seat = |hello: &Hello<'_>| Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello));
            let (mut line, mut device) = (Line::open(&path, None).unwrap(), Device::new("sleepy", seat));
            let (mut bytes, mut answers) = ([0; 512], 0);
            while on.load(Ordering::Relaxed) {
                let count = line.read(&mut bytes);
                device.receive(&bytes[..count], 0, |frame| {
                    answers += 1;
                    if answers == 50 {
                        std::thread::sleep(PAUSE);
                    }
                    line.write(frame);
                });
                std::thread::sleep(NAP);
            }
        })
    });
    let longer = REALTIME.map(|argument| if argument == "8" { "30" } else { argument });
    let summary = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &longer);
    let books = &summary["books"]["roles"];
    println!("{books}; line {}", summary["lines"]["observer"]);
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    for role in ["observer", "controller"] {
        assert!(number(&books[role]["missed"]) >= 28, "{books}");
        // A loaded machine misses more. A role that stops at the pause has executed at most 50.
        assert!(number(&books[role]["executed"]) > 100, "{books}");
    }
}

#[test]
fn plants_go_safe_while_a_flight_computer_is_silent_and_another_replaces_it() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let flight = |path: &Path| {
        Powered::of_rig(
            path,
            short("rigid-pair", &["duration_s=16", "tick_hz=100", "accept={}"]),
            "observer controller",
        )
    };
    let device = flight(&cable.device.path);
    let roles = ["observer", "controller"];
    let longer = REALTIME.map(|argument| if argument == "8" { "16" } else { argument });
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &roles, &longer);
    // The bridge must not give a late device up before the test removes it.
    let first = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &["--patience", "5"]);
    cable.await_ticks();
    drop(device);
    let first = first.wait();
    assert_eq!(first.code, Some(4), "{first:?}");
    assert!(first.says("device-silent"), "{first:?}");
    let _device = flight(&cable.device.path);
    let second = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    let summary = summary_of(&run, &second);
    // The second device has replaced the first in both roles.
    let replaced = incidents(&summary, "continued");
    for role in roles {
        let found = replaced.iter().find(|incident| incident["role"] == role && incident["replaced_by"].is_object());
        assert!(found.is_some(), "{role}: {replaced:?}");
    }
    let books = &summary["books"]["roles"];
    println!("{books}");
    assert!(number(&books["follower"]["safe"]) > 0, "{books}");
    assert!(number(&books["controller"]["missed"]) > 20, "{books}");
    let error = sync_error(&summary);
    let limit = if number(&summary["books"]["missed_ticks"]) < 600 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    bench.assert_clean(&[domain]);
}

#[test]
fn a_killed_bridge_of_a_flight_computer_can_be_started_again() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let arguments = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "60", "--set", "accept={}"];
    let scenario = short("rigid-pair", &["duration_s=60", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&cable.device.path, scenario, "observer controller");
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &["observer", "controller"], &arguments);
    let first = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &[]);
    cable.await_ticks();
    first.signal(SIGKILL);
    assert_eq!(first.wait().signal, Some(SIGKILL));
    let second = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    assert_eq!(second.code, Some(0), "{second:?} {run:?}");
    let with_device = run.succeeded().json();
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &arguments)["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

#[test]
fn in_real_time_a_device_synchronises() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &REALTIME);
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert_eq!(number(&ticks["executed"]) + number(&ticks["missed"]), 801);
    // A loaded machine misses ticks, and the bodies synchronise later.
    let limit = if number(&summary["books"]["missed_ticks"]) < 200 { 1e-6 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let serial = summary["latencies"].as_array().unwrap().iter().find(|stage| stage["stage"] == "serial").unwrap();
    println!("round trip {serial}");
    let answered = number(&serial["count"]) - number(&serial["missed"]);
    assert_eq!((&serial["role"], answered), (&Value::from("follower"), number(&ticks["executed"])));
    assert!(bench.path("out/latency/follower.serial.hgrm").is_file());
}

/// Lost ticks count as missed.
#[test]
fn in_real_time_the_bodies_synchronise_over_a_faulty_line() {
    let bench = Bench::new();
    let faults = Faults { drop: 3e-4, corrupt: 3e-4, garbage: 3e-4, delay: Duration::from_millis(2), pieces: true };
    let cable = Cable::new(faults);
    let _device = Powered::reference(&cable.device.path);
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &REALTIME);
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert_eq!(number(&ticks["executed"]) + number(&ticks["missed"]), 801);
    assert!(number(&line["resyncs"]) > 5 && number(&line["crc_errors"]) > 0, "{line}");
    assert!(number(&line["unanswered"]) <= number(&ticks["missed"]), "{line}");
    let limit = if number(&summary["books"]["missed_ticks"]) < 300 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
}

/// There is noise on the line before the handshake and during the run.
#[test]
fn garbage_before_the_handshake_is_dropped_and_counted() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let host = cable.host.clone();
    let noise = Powered::new(move |on| {
        let mut random = Pcg64::seed_from_u64(3);
        while on.load(Ordering::Relaxed) {
            let garbage: Vec<u8> = (0..100).map(|_| random.next_u64() as u8).collect();
            host.write(&garbage);
            std::thread::sleep(10 * NAP);
        }
    });
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    drop(noise);
    let line = &summary["lines"]["follower"];
    println!("{line}");
    assert!(number(&line["dropped_bytes"]) > 10_000 && number(&line["malformed"]) > 100, "{line}");
    assert_eq!(summary["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
}

/// A cable whose ports have names that disappear when it is unplugged, like those of a USB adapter. The names of ptys are not used,
/// because the next pty takes them at once.
struct Adapter {
    names: [PathBuf; 2],
    cable: Cable,
}

impl Adapter {
    fn plug_in(bench: &Bench) -> Self {
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

#[test]
fn a_device_that_is_unplugged_and_plugged_in_again_continues() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let _device = Powered::reference(&bench.path("tty-device"));
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let bridge = bridge(&bench, &bench.path("tty-host"), &domain, &["--patience", "60"]);
    adapter.cable.await_ticks();
    drop(adapter);
    std::thread::sleep(Duration::from_millis(500));
    let _adapter = Adapter::plug_in(&bench);
    let (run, bridge) = (run.wait(), bridge.wait());
    // A command expires after 50 ms, and the cable was unplugged for longer.
    assert_eq!(bridge.code, Some(4), "{bridge:?} {run:?}");
    let summary = run.succeeded().json();
    let absent = incidents(&summary, "continued");
    let is_long = |incident: &&Value| incident["outage_s"].as_f64().is_some_and(|outage_s| outage_s > 0.3);
    let outage = absent.iter().find(is_long).unwrap_or_else(|| panic!("{absent:?}"));
    assert_eq!(outage["role"], "follower", "{outage}");
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert!(number(&line["reopened"]) >= 1 && number(&line["handshakes"]) >= 2, "{line}");
    assert!(number(&ticks["missed"]) >= 30 && number(&ticks["executed"]) > 0, "{ticks}");
    let limit = if number(&summary["books"]["missed_ticks"]) < 300 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    bench.assert_clean(&[domain]);
}

#[test]
fn a_bridge_whose_device_stays_unplugged_ends_with_a_reason() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let _device = Powered::reference(&bench.path("tty-device"));
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep", "--duration", "100000"]);
    let bridge = bridge(&bench, &bench.path("tty-host"), &domain, &["--patience", "0.5"]);
    adapter.cable.await_ticks();
    drop(adapter);
    let bridge = bridge.wait();
    assert_eq!(bridge.code, Some(4), "{bridge:?}");
    assert!(bridge.says("device-silent"), "{bridge:?}");
    run.signal(SIGINT);
    run.wait();
}

/// The run goes on without it.
#[test]
fn a_controller_that_stays_unplugged_is_an_incident_with_tick_and_time() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let scenario = short("rigid-pair", &["duration_s=8", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&bench.path("tty-device"), scenario, "controller");
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &["controller"], &REALTIME);
    let bridge = bridge_of(&bench, "controller", &bench.path("tty-host"), &domain, &["--patience", "60", "--json"]);
    adapter.cable.await_ticks();
    drop(adapter);
    let (run, bridge) = (run.wait(), bridge.wait());
    assert_eq!(bridge.code, Some(4), "{bridge:?} {run:?}");
    let report = bridge.json();
    let summary = run.json();
    let absent = incidents(&summary, "continued");
    let last = absent.last().unwrap_or_else(|| panic!("{summary:#}"));
    assert_eq!((&last["role"], &last["outage_s"]), (&Value::from("controller"), &Value::Null), "{last}");
    assert!((last["time_s"].as_f64().unwrap() - number(&last["tick"]) as f64 / 100.0).abs() < 1e-9, "{last}");
    let outage = report["outages"].as_array().unwrap().last().unwrap();
    assert_eq!((&outage["tick"], &outage["back_at_tick"]), (&last["tick"], &Value::Null));
    assert!(outage["seconds"].as_f64().unwrap() > 0.5, "{outage}");
    bench.assert_clean(&[domain]);
}

/// A device with another name is refused, or with --allow-other-device accepted and reported.
#[test]
fn a_device_with_another_name_ends_the_run_unless_allowed() {
    for (options, code) in [(&["--patience", "60"][..], 4), (&["--patience", "60", "--allow-other-device"], 0)] {
        let bench = Bench::new();
        let cable = Cable::new(CLEAN);
        let arguments = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "60", "--set", "accept={}"];
        let device = Powered::reference(&cable.device.path);
        let (run, domain) = start(&bench, &shipped("rigid-pair"), &arguments);
        let bridge = bridge(&bench, &cable.host.path, &domain, options);
        cable.await_ticks();
        drop(device);
        let scenario = short("rigid-pair", &["duration_s=60", "tick_hz=100", "accept={}"]);
        let _device = Powered::of_rig(&cable.device.path, scenario, "follower");
        let (run, bridge) = (run.wait(), bridge.wait());
        assert_eq!((bridge.code, run.code), (Some(code), Some(code)), "{bridge:?} {run:?}");
        let summary = run.json();
        let replaced = incidents(&summary, if code == 0 { "continued" } else { "stopped" });
        let text = |incident: &Value| format!("{} {}", incident["cause"], incident["last_words"]);
        assert!(replaced.len() == 1 && text(&replaced[0]).contains("any"), "{replaced:?}");
        assert!(code == 0 || bridge.stderr.contains(NAME), "{bridge:?}");
        bench.assert_clean(&[domain]);
    }
}

/// Starts a device that answers every frame with the bytes that `reply` returns for its payload.
fn scripted(path: &Path, reply: fn(&[u8]) -> Vec<u8>) -> Powered {
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

fn framed(payload: &[u8]) -> Vec<u8> {
    encode(payload, &mut [0; MAX_FRAME]).unwrap().to_vec()
}

/// Asserts that a bridge to `device` ends with this exit code and prints all `words`.
fn refused(device: impl FnOnce(&Path) -> Option<Powered>, arguments: &[&str], code: i32, words: &[&str]) {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = device(&cable.device.path);
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let done = bridge(&bench, &cable.host.path, &domain, arguments).wait();
    assert_eq!(done.code, Some(code), "{done:?}");
    for word in words {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}

#[test]
fn a_device_with_another_protocol_version_is_refused_naming_both_versions() {
    let outdated = |path: &Path| Some(scripted(path, |_| framed(&[1, 0, 2, 0, 0])));
    refused(outdated, &[], 2, &["version 1", "version 2"]);
}

#[test]
fn a_device_of_another_rig_is_refused_naming_both_sample_types() {
    let orbit = |path: &Path| {
        let scenario = Scenario::load(&shipped("orbit-rendezvous"), &[]).unwrap();
        Some(Powered::of_rig(path, scenario, "follower"))
    };
    refused(orbit, &[], 2, &["corotate/orbit/command/v1", "corotate/rigid-body/command/v2"]);
}

/// Returns the frame of a message from a device.
fn frame(message: Message<'_>) -> Vec<u8> {
    framed(write(0, message, &mut [0; MAX_PAYLOAD]).unwrap())
}

const COMMAND: &str = "corotate/rigid-body/command/v2";
/// Another layout under the same type name.
const SWAPPED: &str = "corotate/rigid-body/command/v2#00000000";

#[test]
fn a_device_with_other_fields_under_the_same_type_name_is_refused() {
    let reply = |_: &[u8]| frame(Message::Refuse(Refuse { reason: Reason::Samples, detail: SWAPPED }));
    refused(|path: &Path| Some(scripted(path, reply)), &[], 2, &[SWAPPED, RateCommand::LAYOUT]);
}

/// Devices of protocol version 2 from before layouts had hashes. This one falls silent after the greeting.
#[test]
fn a_device_without_layout_hashes_is_greeted_without_them() {
    let bare = |path: &Path| {
        let reply = |payload: &[u8]| match parse(payload) {
            Ok((_, Message::Hello(hello))) if hello.reads == COMMAND && !hello.writes.contains('#') => {
                frame(Message::Welcome(Welcome { run: hello.run, next_tick: 0, device: "old 1" }))
            }
            Ok((_, Message::Hello(_))) => frame(Message::Refuse(Refuse { reason: Reason::Samples, detail: COMMAND })),
            _ => Vec::new(),
        };
        Some(scripted(path, reply))
    };
    refused(bare, &["--patience", "2"], 4, &["old 1", "[device-silent]"]);
}

#[test]
fn a_bridge_to_a_device_that_never_answers_ends() {
    refused(|_| None, &["--patience", "0.5"], 1, &["[device-silent]"]);
}

#[test]
fn a_looped_line_is_named_as_the_cause() {
    let echo = |path: &Path| Some(scripted(path, framed));
    refused(echo, &["--patience", "5"], 1, &["[device-silent]", "looped"]);
}

#[test]
fn a_line_at_another_speed_is_named_as_the_cause() {
    let noise = |path: &Path| Some(scripted(path, |payload| vec![0x55; payload.len()]));
    refused(noise, &["--patience", "5"], 1, &["[device-silent]", "--baud"]);
}

#[test]
fn a_line_too_slow_for_the_tick_is_refused() {
    refused(|_| None, &["--baud", "9600"], 2, &["9600", "--baud", "tick_hz"]);
}

#[test]
fn a_bridge_refuses_wrong_roles_domains_and_files_that_are_not_lines() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let file = bench.path("file");
    std::fs::write(&file, "text").unwrap();
    let assert_refused = |path: &Path, role: &str, domain: &Path, code: &str| {
        let (path, domain) = (path.to_str().unwrap(), domain.to_str().unwrap());
        let done = bench.run(&["bridge", "--serial", path, "--role", role, "--domain", domain]);
        assert!(done.code == Some(2) && done.codes() == [code], "{path} {role} {domain}: {done:?}");
    };
    for path in [&file, &domain, Path::new("/dev/null")] {
        assert_refused(path, "follower", &domain, "not-a-terminal");
    }
    assert_refused(&bench.path("missing"), "follower", &domain, "cannot-open-line");
    assert_refused(&port.path, "leader", &domain, "no-device-role");
    assert_refused(&port.path, "moon", &domain, "no-such-role");
    assert_refused(&port.path, "follower", &bench.path("missing"), "not-a-domain");
    let _held = Line::open(&port.path, None).unwrap();
    assert_refused(&port.path, "follower", &domain, "line-in-use");
    run.signal(SIGINT);
    run.wait();
}

#[test]
fn a_body_on_a_device_needs_an_actuation_delay_of_one_tick() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) =
        start(&bench, &shipped("rigid-pair"), &[&REALTIME[..], &["--set=actuation_delay_ticks=2"]].concat());
    let done = bridge(&bench, &port.path, &domain, &[]).wait();
    assert_eq!(done.code, Some(2), "{done:?}");
    for word in ["[device-delay]", "actuation_delay_ticks = 2"] {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}

/// The next bridge continues with the persistent counters, and the device recognises the run.
#[test]
fn a_killed_bridge_can_be_started_again() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let arguments = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "60", "--set", "accept={}"];
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &arguments);
    let first = bridge(&bench, &cable.host.path, &domain, &[]);
    cable.await_ticks();
    first.signal(SIGKILL);
    assert_eq!(first.wait().signal, Some(SIGKILL));
    let second = bridge(&bench, &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    assert_eq!(second.code, Some(0), "{second:?} {run:?}");
    let with_device = run.succeeded().json();
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &arguments)["state"]["hash"]);
    assert_eq!(number(&with_device["books"]["roles"]["follower"]["executed"]), 6001);
    bench.assert_clean(&[domain]);
}

/// Its body starts again at the initial state, and the run goes on.
#[test]
fn a_restarted_device_is_reported_as_an_incident() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let device = Powered::reference(&cable.device.path);
    let arguments = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "60", "--set", "accept={}"];
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &arguments);
    let bridge = bridge(&bench, &cable.host.path, &domain, &["--patience", "60"]);
    cable.await_ticks();
    drop(device);
    let _device = Powered::reference(&cable.device.path);
    let (run, bridge) = (run.wait(), bridge.wait());
    assert_eq!(bridge.code, Some(0), "{bridge:?} {run:?}");
    assert!(run.says("device-restarted"), "{run:?}");
    let summary = run.succeeded().json();
    let lost = incidents(&summary, "continued");
    assert!(lost.len() == 1 && lost[0]["role"] == "follower" && lost[0]["code"] == "device-restarted", "{lost:?}");
    assert!(bridge.stderr.contains("initial state"), "{bridge:?}");
    let line = &summary["lines"]["follower"];
    // A bridge greets a device again after a long silence.
    assert_eq!((number(&line["restarts"]), number(&line["handshakes"]) >= 2), (1, true), "{line}");
    assert!(number(&summary["state"]["first_disturbed_tick"]) > 0, "{}", summary["state"]);
    assert_ne!(summary["state"]["hash"], bench.summary("rigid-pair", &arguments)["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

/// The bridge sends the end of the run, upon which the device goes safe.
#[test]
fn an_interrupted_bridge_leaves_its_device_safe() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let path = cable.device.path.clone();
    let safe = Arc::new(AtomicBool::new(true));
    let flag = safe.clone();
    let _device = Powered::new(move |on| {
        let mut device = Device::new(NAME, Follower::asked_for);
        let mut line = Line::open(&path, None).unwrap();
        let mut bytes = [0; 512];
        while on.load(Ordering::Relaxed) {
            let count = line.read(&mut bytes);
            // The device's clock stands at 0, so it cannot go safe by a timeout.
            device.receive(&bytes[..count], 0, |frame| {
                line.write(frame);
            });
            flag.store(device.is_safe(), Ordering::Relaxed);
            std::thread::sleep(NAP);
        }
    });
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep", "--duration", "100000"]);
    let bridge = bridge(&bench, &cable.host.path, &domain, &[]);
    await_some(|| (!safe.load(Ordering::Relaxed)).then_some(()));
    bridge.signal(SIGINT);
    bridge.wait().succeeded();
    await_some(|| safe.load(Ordering::Relaxed).then_some(()));
    run.signal(SIGINT);
    run.wait();
}
