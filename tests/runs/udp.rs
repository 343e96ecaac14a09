//! Devices at a UDP address: the bridge as a process, the device in a thread, and between them a network that loses, doubles and
//! reorders datagrams.

use super::serial::serial_device::{Follower, NAME};
use super::serial::start;
use crate::common::{Bench, shipped};
use corotate::serial::{Device, MAX_FRAME};
use libc::SIGINT;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use serde_json::Value;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Longest wait for a datagram before a thread looks whether it shall end.
const LOOK: Duration = Duration::from_millis(1);
/// Longest delay of a datagram that others overtake: more than the interval at which a request is repeated.
const OVERTAKEN: Duration = Duration::from_millis(15);

/// A thread that runs until it is dropped.
pub(super) struct Service {
    pub address: SocketAddr,
    on: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Service {
    /// Binds an address of this machine and serves it in a thread.
    fn new(own: &str, life: impl FnOnce(UdpSocket, &AtomicBool) + Send + 'static) -> Self {
        let socket = UdpSocket::bind(own).unwrap();
        socket.set_read_timeout(Some(LOOK)).unwrap();
        let (address, on) = (socket.local_addr().unwrap(), Arc::new(AtomicBool::new(true)));
        let flag = on.clone();
        Self { address, on, thread: Some(std::thread::spawn(move || life(socket, &flag))) }
    }

    /// Starts the follower of `rigid-pair`.
    pub fn device(own: &str) -> Self {
        Self::new(own, |socket, on| {
            let (mut device, mut bytes, began) =
                (Device::new(NAME, Follower::asked_for), [0; MAX_FRAME], Instant::now());
            while on.load(Ordering::Relaxed) {
                let now_ns = began.elapsed().as_nanos() as u64;
                if let Ok((count, host)) = socket.recv_from(&mut bytes) {
                    device.receive(&bytes[..count], now_ns, |frame| {
                        socket.send_to(frame, host).unwrap();
                    });
                }
                device.elapse(now_ns);
            }
        })
    }

    /// Starts a network in front of a device. Each datagram is lost, doubled or overtaken with these probabilities.
    fn network(device: SocketAddr, lost: f64, doubled: f64, overtaken: f64) -> Self {
        Self::new("127.0.0.1:0", move |near, on| {
            let far = UdpSocket::bind("127.0.0.1:0").unwrap();
            far.connect(device).unwrap();
            far.set_nonblocking(true).unwrap();
            near.set_nonblocking(true).unwrap();
            let (mut random, mut bytes) = (Pcg64::seed_from_u64(1), [0; MAX_FRAME]);
            let mut uniform = move || random.next_u64() as f64 / u64::MAX as f64;
            let mut host = None;
            // Datagrams on their way: when they arrive, true if at the device, and their bytes.
            let mut flying: Vec<(Instant, bool, Vec<u8>)> = Vec::new();
            while on.load(Ordering::Relaxed) {
                let now = Instant::now();
                let mut send = |to_device: bool, bytes: &[u8]| {
                    if uniform() < lost {
                        return;
                    }
                    for _ in 0..1 + usize::from(uniform() < doubled) {
                        let delay = if uniform() < overtaken { OVERTAKEN.mul_f64(uniform()) } else { Duration::ZERO };
                        flying.push((now + delay, to_device, bytes.to_vec()));
                    }
                };
                while let Ok((count, from)) = near.recv_from(&mut bytes) {
                    host = Some(from);
                    send(true, &bytes[..count]);
                }
                while let Ok(count) = far.recv(&mut bytes) {
                    send(false, &bytes[..count]);
                }
                flying.retain(|(due, to_device, bytes)| {
                    // A datagram that the socket refuses is lost.
                    let _ = match (*due <= now, to_device, host) {
                        (true, true, _) => far.send(bytes),
                        (true, false, Some(host)) => near.send_to(bytes, host),
                        _ => return true,
                    };
                    false
                });
                std::thread::sleep(Duration::from_micros(50));
            }
        })
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
        let result = self.thread.take().map(JoinHandle::join);
        assert!(std::thread::panicking() || matches!(result, Some(Ok(()))), "the thread failed");
    }
}

const LOCKSTEP: [&str; 6] = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "10"];

/// Runs `rigid-pair` with the device at an address as its follower. Returns the summary, and the counters of the line.
fn run_with(bench: &Bench, address: SocketAddr) -> (Value, Value) {
    let (run, domain) = start(bench, &shipped("rigid-pair"), &LOCKSTEP);
    let address = address.to_string();
    let bridge = ["bridge", "--udp", &address, "--role", "follower", "--domain", domain.to_str().unwrap(), "--json"];
    let bridge = bench.start(&bridge).wait();
    let summary = run.wait().succeeded().json();
    assert_eq!(bridge.code, Some(0), "{bridge:?}");
    bench.assert_clean(&[domain]);
    let line = summary["lines"]["follower"].clone();
    assert_eq!(bridge.json()["line"], line);
    (summary, line)
}

fn assert_same_bits(bench: &Bench, with_device: &Value) {
    let built_in = bench.summary("rigid-pair", &LOCKSTEP);
    assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"]);
    assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"]);
}

#[test]
fn in_lockstep_a_device_at_a_udp_address_gives_the_bits_of_the_built_in_follower() {
    for own in ["127.0.0.1:0", "[::1]:0"] {
        let bench = Bench::new();
        let device = Service::device(own);
        let (summary, line) = run_with(&bench, device.address);
        assert_same_bits(&bench, &summary);
        assert!(line["frames_received"].as_u64() >= Some(1002) && line["malformed"] == 0, "{line}");
    }
}

#[test]
fn in_lockstep_lost_doubled_and_overtaken_datagrams_change_no_bit() {
    let bench = Bench::new();
    let device = Service::device("127.0.0.1:0");
    let network = Service::network(device.address, 0.05, 0.10, 0.25);
    let (summary, line) = run_with(&bench, network.address);
    assert_same_bits(&bench, &summary);
    println!("{line}");
    let at_least = |key: &str, count: u64| line[key].as_u64().unwrap() >= count;
    assert!(at_least("repeats", 50) && at_least("sequence_gaps", 20) && at_least("duplicates", 20), "{line}");
    assert!(line["unanswered"] == 0 && line["restarts"] == 0 && line["malformed"] == 0, "{line}");
}

/// Returns the exit code and the error codes of a bridge to an address.
fn refused(bench: &Bench, domain: &Path, address: &str, arguments: &[&str]) -> (Option<i32>, Vec<String>) {
    let common = ["bridge", "--udp", address, "--role", "follower", "--domain", domain.to_str().unwrap()];
    let done = bench.run(&[&common[..], arguments].concat());
    (done.code, done.codes().iter().map(|code| (*code).to_owned()).collect())
}

#[test]
fn an_address_beyond_loopback_or_without_a_device_is_refused() {
    let bench = Bench::new();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &LOCKSTEP);
    for open in ["192.0.2.1:7700", "[2001:db8::1]:7700"] {
        assert_eq!(refused(&bench, &domain, open, &[]), (Some(2), vec!["open-address".to_owned()]));
    }
    // The address is for documentation: no device answers there.
    let insecure = refused(&bench, &domain, "192.0.2.1:7700", &["--insecure", "--patience", "0.3"]);
    assert!(insecure.1 == ["device-silent"] || insecure.1 == ["no-route"], "{insecure:?}");
    let unused = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let silent = bench.run(&[
        "bridge",
        "--udp",
        &unused,
        "--role",
        "follower",
        "--domain",
        domain.to_str().unwrap(),
        "--patience",
        "0.3",
    ]);
    assert!(silent.code == Some(1) && silent.codes() == ["device-silent"], "{silent:?}");
    assert!(silent.stderr.contains("no program receives"), "{silent:?}");
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}
