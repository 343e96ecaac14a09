//! A device behind a serial line in the follower's seat: the real program, a device in a thread, and between them a cable
//! of two ptys that can be faulty, cut, and joined again.

#[path = "../../examples/serial_device.rs"]
mod serial_device;

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

/// One end of a cable: a pty whose near end stands for a serial port. It stays raw and open while nobody uses it.
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

    /// What a full line does not take is lost, as it is on a real one.
    fn write(&self, bytes: &[u8]) {
        let _ = rustix::io::write(&self.far, bytes);
    }
}

/// What befalls bytes on their way: probabilities per byte, and the longest delay of a read's worth of them.
#[derive(Clone, Copy)]
struct Faults {
    drop: f64,
    corrupt: f64,
    garbage: f64,
    delay: Duration,
    /// Whether the bytes are cut into pieces and joined at random.
    pieces: bool,
}

const CLEAN: Faults = Faults { drop: 0.0, corrupt: 0.0, garbage: 0.0, delay: Duration::ZERO, pieces: false };

/// A cable between the bridge's port and the device's.
struct Cable {
    host: Arc<Port>,
    device: Arc<Port>,
    whole: Arc<AtomicBool>,
    /// Bytes that came to the device's end.
    carried: Arc<AtomicUsize>,
    pumps: Vec<JoinHandle<()>>,
}

impl Cable {
    fn new(faults: Faults) -> Self {
        let (host, device) = (Arc::new(Port::new()), Arc::new(Port::new()));
        let whole = Arc::new(AtomicBool::new(true));
        let carried = Arc::new(AtomicUsize::new(0));
        let pump = |from: &Arc<Port>, to: &Arc<Port>, seed, carried: Option<&Arc<AtomicUsize>>| {
            let (from, to, whole, carried) = (from.clone(), to.clone(), whole.clone(), carried.cloned());
            std::thread::spawn(move || pump(&from, &to, faults, seed, &whole, carried.as_deref()))
        };
        let pumps = vec![pump(&host, &device, 1, Some(&carried)), pump(&device, &host, 2, None)];
        Self { host, device, whole, carried, pumps }
    }

    /// Waits until ticks run over it: some hundred of them have.
    fn await_ticks(&self) {
        await_some(|| (self.carried.load(Ordering::Relaxed) > 10_000).then_some(()));
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.whole.store(false, Ordering::Relaxed);
        self.pumps.drain(..).for_each(|pump| pump.join().unwrap());
    }
}

fn pump(from: &Port, to: &Port, faults: Faults, seed: u64, whole: &AtomicBool, carried: Option<&AtomicUsize>) {
    let (mut random, mut bytes) = (Pcg64::seed_from_u64(seed), [0; 4096]);
    let mut uniform = move || random.next_u64() as f64 / u64::MAX as f64;
    while whole.load(Ordering::Relaxed) {
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
    /// Runs `life` in a thread; it ends when the flag it is given is cleared.
    fn new(life: impl FnOnce(&AtomicBool) + Send + 'static) -> Self {
        let on = Arc::new(AtomicBool::new(true));
        let flag = on.clone();
        Self { on, thread: Some(std::thread::spawn(move || life(&flag))) }
    }

    /// The reference device: `examples/serial_device.rs`.
    fn reference(path: &Path) -> Self {
        let path = path.to_owned();
        Self::new(move |on| live(&path, &mut Device::new(NAME, Follower::asked_for), on))
    }

    /// A device with any role of any rig.
    fn of_rig(path: &Path, scenario: Scenario, role: &'static str) -> Self {
        let path = path.to_owned();
        Self::new(move |on| with_shipped_rig!(scenario.rig, rig => any_role(rig, role, &path, on)))
    }
}

impl Drop for Powered {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
        let ended = self.thread.take().map(JoinHandle::join);
        assert!(std::thread::panicking() || matches!(ended, Some(Ok(()))), "the device failed");
    }
}

/// The role of this name, or the body; controllers are of one driven body.
fn any_role<R: Rig>(rig: &R, role: &str, path: &Path, on: &AtomicBool) {
    let asked = |hello: &Hello<'_>| assert_eq!(hello.role, role);
    match role {
        "observer" => live(
            path,
            &mut Device::new("any", |hello| {
                asked(hello);
                Some(DeviceObserver::new(rig.estimator(), hello))
            }),
            on,
        ),
        "controller" => live(
            path,
            &mut Device::new("any", |hello| {
                asked(hello);
                Some(DeviceController::new([rig.law(1)]))
            }),
            on,
        ),
        "observer controller" => live(
            path,
            &mut Device::new("any", |hello| {
                asked(hello);
                Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello))
            }),
            on,
        ),
        _ => live(
            path,
            &mut Device::new("any", |hello| {
                asked(hello);
                Some(DevicePlant::new(rig.body(1), hello))
            }),
            on,
        ),
    }
}

/// A device keeps its state while its line is cut and joined again.
fn live<S: DeviceRole, M: FnMut(&Hello<'_>) -> Option<S>>(path: &Path, device: &mut Device<S, M>, on: &AtomicBool) {
    while on.load(Ordering::Relaxed) {
        match Line::open(path, None) {
            Ok(mut line) => serve(&mut line, device, on),
            Err(_) => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}

/// Starts a run whose follower somebody else is; gives its domain too.
fn start(bench: &Bench, file: &Path, arguments: &[&str]) -> (Running, PathBuf) {
    start_without(bench, file, &["follower"], arguments)
}

/// The same for any roles.
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

/// Runs a shipped scenario with the device at `path` in the follower's seat.
fn run_with(bench: &Bench, scenario: &str, path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start(bench, &shipped(scenario), arguments);
    let bridge = bridge(bench, path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    assert!(bridge.stderr.contains("line of follower: "), "{bridge:?}");
    bench.assert_clean(&[domain]);
    served(&run, &bridge)
}

/// The summary of a run. A machine that withholds the processor from a device for long makes it absent; then both ends tell.
fn served(run: &Done, bridge: &Done) -> Value {
    let summary = run.json();
    assert_eq!(run.code, Some(0), "{run:?}");
    let absent = incidents(&summary, "continued").iter().any(|incident| incident["replaced_by"].is_null());
    assert_eq!(bridge.code, Some(if absent { 4 } else { 0 }), "{bridge:?} {run:?}");
    assert!(!absent || summary["clock"] == "realtime", "{summary:#}");
    summary
}

/// The incidents of a run about which this was done.
fn incidents(summary: &Value, action: &str) -> Vec<Value> {
    let all = summary["incidents"].as_array().unwrap();
    all.iter().filter(|incident| incident["action"] == action).cloned().collect()
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is no count"))
}

/// The error of the first metric at the end of a run.
fn sync_error(summary: &Value) -> f64 {
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    summary["score"]["metrics"][0]["last"].as_f64().unwrap()
}

const LOCKSTEP: [&str; 6] = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "10"];
/// A loaded machine may keep a bridge from saying anything for seconds.
const PATIENT: &str = "--set=supervision.heartbeat_timeout_s=60";
const REALTIME: [&str; 9] =
    ["--clock", "realtime", "--tick-hz", "100", "--duration", "8", "--set", "accept={}", PATIENT];

/// The device computes with the same pure plant: nothing of the run tells that it sits behind a line.
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

/// Every request is repeated until it is answered, and no tick is executed twice: no fault reaches the bits.
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

/// The protocol knows no rig.
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

/// The seats that a device can have beside a body's, as the command line names them and as a device hears them.
const COMPUTERS: [(&[&str], &str); 3] = [
    (&["observer"], "observer"),
    (&["controller"], "controller"),
    (&["observer", "controller"], "observer controller"),
];

/// Runs a shipped scenario with a device in the seats of these roles.
fn run_roles(bench: &Bench, scenario: &str, roles: &[&str], path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start_without(bench, &shipped(scenario), roles, arguments);
    let bridge = bridge_of(bench, &roles.join(","), path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    bench.assert_clean(&[domain]);
    served(&run, &bridge)
}

fn short(scenario: &str, arguments: &[&str]) -> Scenario {
    let overrides: Vec<String> = arguments.iter().map(|argument| (*argument).to_owned()).collect();
    Scenario::parse(&std::fs::read_to_string(shipped(scenario)).unwrap(), "test", &overrides).unwrap()
}

/// What computes sits behind the line, what moves is simulated here: processor in the loop.
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
            // One for all roles of a line; a device that is served late is greeted again after 8 requests, 7 of them repeated.
            let line = &with_device["lines"][roles[0]];
            let (handshakes, repeats) = (number(&line["handshakes"]), number(&line["repeats"]));
            assert!(handshakes >= 1 && 7 * (handshakes - 1) <= repeats, "{line:#}");
        }
    }
}

/// The leader's measurements that are dropped, and a follower's, come to such a device as to ours.
#[test]
fn in_lockstep_a_flight_computer_on_a_faulty_line_that_misses_samples_gives_the_same_bits() {
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

/// What a flight computer does not answer in time is missed, and the next tick is asked for.
#[test]
fn a_flight_computer_that_pauses_misses_what_it_slept_through_and_no_more() {
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
    let longer = REALTIME.map(|word| if word == "8" { "30" } else { word });
    let summary = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &longer);
    let books = &summary["books"]["roles"];
    println!("{books}; line {}", summary["lines"]["observer"]);
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    for role in ["observer", "controller"] {
        assert!(number(&books[role]["missed"]) >= 28, "{books}");
        // A machine that withholds the processor misses more; whoever does not go on has executed 50 at the most.
        assert!(number(&books[role]["executed"]) > 100, "{books}");
    }
}

/// The plants have their expiry, whoever is to command them.
#[test]
fn a_flight_computer_that_falls_silent_leaves_its_plants_safe_and_another_one_takes_its_seat() {
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
    let longer = REALTIME.map(|word| if word == "8" { "16" } else { word });
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &roles, &longer);
    // A device that is only served late must not be given up before the test takes it away.
    let first = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &["--patience", "5"]);
    cable.await_ticks();
    drop(device);
    let first = first.wait();
    assert_eq!(first.code, Some(4), "{first:?}");
    assert!(first.says("device-silent"), "{first:?}");
    let _device = flight(&cable.device.path);
    let second = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    let summary = served(&run, &second);
    // The seat of each role changed hands.
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
    // A machine that withholds the processor gives a slower loop, and says so.
    let limit = if number(&summary["books"]["missed_ticks"]) < 200 { 1e-6 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let serial = summary["latencies"].as_array().unwrap().iter().find(|stage| stage["stage"] == "serial").unwrap();
    println!("round trip {serial}");
    let told = number(&serial["count"]) - number(&serial["missed"]);
    assert_eq!((&serial["role"], told), (&Value::from("follower"), number(&ticks["executed"])));
    assert!(bench.path("out/latency/follower.serial.hgrm").is_file());
}

/// What is lost is counted as missed; the bodies synchronise all the same.
#[test]
fn in_real_time_a_faulty_line_costs_ticks_and_not_the_goal() {
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

/// Noise on the line before anybody says anything, and all the time after.
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

/// A cable under names of its own, which go when it is unplugged, as those of a USB adapter do: the numbers of ptys are used
/// again at once, by whoever comes next.
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
fn a_device_that_is_unplugged_and_plugged_in_again_goes_on() {
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
    // A command lasts 50 ms, and the cable was out for longer.
    assert_eq!(bridge.code, Some(4), "{bridge:?} {run:?}");
    let summary = run.succeeded().json();
    let absent = incidents(&summary, "continued");
    let cut = absent.iter().find(|incident| incident["cause"].as_str().unwrap().contains("was cut"));
    let cut = cut.unwrap_or_else(|| panic!("{absent:?}"));
    assert_eq!((&cut["role"], cut["outage_s"].as_f64().unwrap() > 0.3), (&Value::from("follower"), true), "{cut}");
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
fn a_device_that_does_not_come_back_ends_the_bridge_with_the_reason() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let _device = Powered::reference(&bench.path("tty-device"));
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep", "--duration", "100000"]);
    let bridge = bridge(&bench, &bench.path("tty-host"), &domain, &["--patience", "0.5"]);
    adapter.cable.await_ticks();
    drop(adapter);
    let bridge = bridge.wait();
    assert_eq!(bridge.code, Some(4), "{bridge:?}");
    assert!(bridge.stderr.contains("has not answered for") && bridge.stderr.contains("plugged in"), "{bridge:?}");
    run.signal(SIGINT);
    run.wait();
}

/// The run goes on without it; both programs tell that it was not there.
#[test]
fn a_controller_whose_line_stays_cut_is_an_incident_with_tick_and_time() {
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
    let told = bridge.json();
    let summary = run.json();
    let absent = incidents(&summary, "continued");
    let last = absent.last().unwrap_or_else(|| panic!("{summary:#}"));
    assert_eq!((&last["role"], &last["outage_s"]), (&Value::from("controller"), &Value::Null), "{last}");
    assert!((last["time_s"].as_f64().unwrap() - number(&last["tick"]) as f64 / 100.0).abs() < 1e-9, "{last}");
    let outage = told["outages"].as_array().unwrap().last().unwrap();
    assert_eq!((&outage["tick"], &outage["back_at_tick"]), (&last["tick"], &Value::Null));
    assert!(outage["seconds"].as_f64().unwrap() > 0.5, "{outage}");
    bench.assert_clean(&[domain]);
}

/// A device of another name is not taken for the one that was there, unless it is allowed; then it is told.
#[test]
fn another_device_on_the_line_is_refused_or_told() {
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
        let _other = Powered::of_rig(&cable.device.path, scenario, "follower");
        let (run, bridge) = (run.wait(), bridge.wait());
        assert_eq!((bridge.code, run.code), (Some(code), Some(code)), "{bridge:?} {run:?}");
        let summary = run.json();
        let told = incidents(&summary, if code == 0 { "continued" } else { "stopped" });
        let words = |incident: &Value| format!("{} {}", incident["cause"], incident["last_words"]);
        assert!(told.len() == 1 && words(&told[0]).contains("any"), "{told:?}");
        assert!(code == 0 || bridge.stderr.contains(NAME), "{bridge:?}");
        bench.assert_clean(&[domain]);
    }
}

/// Answers every frame with the bytes that `reply` makes of its payload.
fn impostor(path: &Path, reply: fn(&[u8]) -> Vec<u8>) -> Powered {
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

/// A bridge to `device` must end by itself with this code, and say all of these.
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
fn a_device_of_another_version_is_refused_by_both_versions() {
    let other = |path: &Path| Some(impostor(path, |_| framed(&[1, 0, 2, 0, 0])));
    refused(other, &[], 2, &["protocol version 1", "this program version 2", "update the older"]);
}

#[test]
fn a_device_of_another_rig_is_refused_by_both_types() {
    let orbit = |path: &Path| {
        let scenario = Scenario::load(&shipped("orbit-rendezvous"), &[]).unwrap();
        Some(Powered::of_rig(path, scenario, "follower"))
    };
    refused(orbit, &[], 2, &["corotate/orbit/command/v1", "corotate/rigid-body/command/v2"]);
}

/// The answer of a device to a greeting.
fn answered(message: Message<'_>) -> Vec<u8> {
    framed(write(0, message, &mut [0; MAX_PAYLOAD]).unwrap())
}

const COMMAND: &str = "corotate/rigid-body/command/v2";
/// Another layout under the same type name.
const SWAPPED: &str = "corotate/rigid-body/command/v2#00000000";

#[test]
fn a_device_with_other_fields_under_the_same_type_name_is_refused() {
    let reply = |_: &[u8]| answered(Message::Refuse(Refuse { reason: Reason::Samples, detail: SWAPPED }));
    refused(|path: &Path| Some(impostor(path, reply)), &[], 2, &[SWAPPED, RateCommand::LAYOUT]);
}

/// A device of protocol version 2 from before layouts had hashes. This one falls silent after the greeting.
#[test]
fn a_device_that_knows_type_names_only_is_greeted_so_and_named() {
    let bare = |path: &Path| {
        let reply = |payload: &[u8]| match parse(payload) {
            Ok((_, Message::Hello(hello))) if hello.reads == COMMAND && !hello.writes.contains('#') => {
                answered(Message::Welcome(Welcome { run: hello.run, next_tick: 0, device: "old 1" }))
            }
            Ok((_, Message::Hello(_))) => {
                answered(Message::Refuse(Refuse { reason: Reason::Samples, detail: COMMAND }))
            }
            _ => Vec::new(),
        };
        Some(impostor(path, reply))
    };
    refused(bare, &["--patience", "2"], 4, &["old 1 (states no layouts", "has not answered for"]);
}

#[test]
fn a_device_that_never_answers_is_given_up() {
    refused(|_| None, &["--patience", "0.5"], 1, &["has not answered for", "powered, wired"]);
}

#[test]
fn a_looped_line_is_told_from_a_silent_one() {
    let echo = |path: &Path| Some(impostor(path, framed));
    refused(echo, &["--patience", "5"], 1, &["has not answered", "own frames came back"]);
}

#[test]
fn a_line_at_another_speed_is_told_from_a_silent_one() {
    let noise = |path: &Path| Some(impostor(path, |payload| vec![0x55; payload.len()]));
    refused(noise, &["--patience", "5"], 1, &["has not answered", "no frame was among them", "--baud"]);
}

#[test]
fn a_line_too_slow_for_the_tick_is_refused_with_the_least_speed() {
    refused(|_| None, &["--baud", "9600"], 2, &["at 9600 baud", "give --baud", "tick_hz"]);
}

#[test]
fn what_is_no_seat_or_no_line_is_refused_with_a_remedy() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let file = bench.path("file");
    std::fs::write(&file, "no line").unwrap();
    let ask = |path: &Path, body: &str, domain: &Path| {
        let (path, domain) = (path.to_str().unwrap(), domain.to_str().unwrap());
        let done = bench.run(&["bridge", "--serial", path, "--role", body, "--domain", domain]);
        assert_eq!(done.code, Some(2), "{done:?}");
        done.stderr
    };
    for path in [&file, &domain, Path::new("/dev/null")] {
        assert!(ask(path, "follower", &domain).contains("not a terminal device"));
    }
    assert!(ask(&bench.path("none"), "follower", &domain).contains("plugged in"));
    assert!(ask(&port.path, "leader", &domain).contains("one driven body"));
    assert!(ask(&port.path, "nobody", &domain).contains("there is no role `nobody`"));
    assert!(ask(&port.path, "follower", &bench.path("none")).contains("not the domain of a run"));
    let _held = Line::open(&port.path, None).unwrap();
    assert!(ask(&port.path, "follower", &domain).contains("in use by another program"));
    run.signal(SIGINT);
    run.wait();
}

#[test]
fn a_run_whose_commands_act_later_than_at_the_next_tick_is_no_run_for_a_device_that_is_a_body() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) =
        start(&bench, &shipped("rigid-pair"), &[&REALTIME[..], &["--set=actuation_delay_ticks=2"]].concat());
    let done = bridge(&bench, &port.path, &domain, &[]).wait();
    assert_eq!(done.code, Some(2), "{done:?}");
    for word in ["actuation_delay_ticks = 2", "give 1", "simulated plant"] {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}

/// A bridge that dies takes nothing with it: the next one finds the books where they were, and a device that knows the run.
#[test]
fn a_bridge_that_was_killed_can_be_started_again() {
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

/// A device that loses the run in the midst begins its body anew: the loop goes on, and is told what happened.
#[test]
fn a_device_that_was_restarted_is_told_as_that() {
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
    let told = "1 times the device lost the run, its body at the initial state again";
    for text in [&bridge.stderr, &run.stderr] {
        assert!(text.contains(told) && !text.contains("no fault"), "{text}");
    }
    let summary = run.succeeded().json();
    let lost = incidents(&summary, "continued");
    assert!(lost.len() == 1 && lost[0]["cause"].as_str().unwrap().contains("had lost the run"), "{lost:?}");
    let line = &summary["lines"]["follower"];
    // Who has not heard from its device for long greets it once more.
    assert_eq!((number(&line["restarts"]), number(&line["handshakes"]) >= 2), (1, true), "{line}");
    assert!(number(&summary["state"]["first_disturbed_tick"]) > 0, "{}", summary["state"]);
    assert_ne!(summary["state"]["hash"], bench.summary("rigid-pair", &arguments)["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

/// The device hears of the end, and is safe at once.
#[test]
fn a_bridge_that_is_interrupted_leaves_its_device_safe() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let path = cable.device.path.clone();
    let safe = Arc::new(AtomicBool::new(true));
    let told = safe.clone();
    let _device = Powered::new(move |on| {
        let mut device = Device::new(NAME, Follower::asked_for);
        let mut line = Line::open(&path, None).unwrap();
        let mut bytes = [0; 512];
        while on.load(Ordering::Relaxed) {
            let count = line.read(&mut bytes);
            // No clock: it is the word of the bridge that makes it safe, not silence.
            device.receive(&bytes[..count], 0, |frame| {
                line.write(frame);
            });
            told.store(device.is_safe(), Ordering::Relaxed);
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
