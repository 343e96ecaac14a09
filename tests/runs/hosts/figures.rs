//! Prints latencies of runs over several hosts: `cargo test --release --features hosts --test all hosts::figures -- --ignored --nocapture`.

use super::sites::{APART_S, Site, apart, sites};
use super::{KEYS, Run, TWO, UNJUDGED, finish};
use std::net::UdpSocket;
use std::time::{Duration, Instant};
use zenoh::Wait;

/// Number of round trips of each baseline.
const ROUNDS: usize = 2000;
/// Length of a message, bytes: that of one with a measurement of `rigid-pair`.
const BYTES: usize = 108;
/// Pause between round trips: the period at 200 Hz.
const PAUSE: Duration = Duration::from_millis(5);

/// Returns p50 and p99 of half the round trip, µs.
fn half_round_trips(mut round_trip: impl FnMut()) -> (f64, f64) {
    let mut halves: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            std::thread::sleep(PAUSE);
            let sent = Instant::now();
            round_trip();
            sent.elapsed().as_secs_f64() * 5e5
        })
        .collect();
    halves.sort_by(f64::total_cmp);
    (halves[ROUNDS / 2], halves[ROUNDS * 99 / 100])
}

/// Runs `act` in a site's network.
fn at<T: Send>(site: &Site, act: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        let there = scope.spawn(|| {
            site.enter();
            act()
        });
        there.join().unwrap()
    })
}

fn udp(sites: &[Site]) -> (f64, f64) {
    let near = at(&sites[0], || UdpSocket::bind("0.0.0.0:0").unwrap());
    let to = format!("{}:{}", sites[1].hub(), near.local_addr().unwrap().port());
    let far = at(&sites[1], || UdpSocket::bind("0.0.0.0:0").unwrap());
    far.connect(to).unwrap();
    std::thread::spawn(move || {
        let mut bytes = [0; BYTES];
        while let Ok((length, from)) = near.recv_from(&mut bytes) {
            // An empty datagram ends the thread.
            if length == 0 || near.send_to(&bytes[..length], from).is_err() {
                break;
            }
        }
    });
    let mut bytes = [0; BYTES];
    let latencies = half_round_trips(|| {
        far.send(&bytes).unwrap();
        far.recv(&mut bytes).unwrap();
    });
    far.send(&[]).unwrap();
    latencies
}

fn session(mode: &str, side: &str, address: &str) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let endpoints = format!("[\"{address}\"]");
    let unused = if side == "listen" { "connect" } else { "listen" };
    for (key, value) in [
        ("mode", format!("\"{mode}\"").as_str()),
        (&format!("{side}/endpoints"), &endpoints),
        (&format!("{unused}/endpoints"), "[]"),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// Measures zenoh without corotate: publishers and subscribers as in zenoh's own ping example, with the subscribers' queues.
fn zenoh_put(sites: &[Site]) -> (f64, f64) {
    let near = at(&sites[0], || session("router", "listen", "tcp/0.0.0.0:7900"));
    let far = at(&sites[1], || session("client", "connect", &format!("tcp/{}:7900", sites[1].hub())));
    let publisher = |session: &zenoh::Session, key| session.declare_publisher(key).express(true).wait().unwrap();
    let (ping, pong) = (publisher(&far, "ping"), publisher(&near, "pong"));
    let answers = near.declare_subscriber("ping").wait().unwrap();
    std::thread::spawn(move || {
        while let Ok(sample) = answers.recv() {
            if pong.put(sample.payload().clone()).wait().is_err() {
                break;
            }
        }
    });
    let replies = far.declare_subscriber("pong").wait().unwrap();
    std::thread::sleep(Duration::from_secs(1));
    half_round_trips(|| {
        ping.put(vec![0_u8; BYTES]).wait().unwrap();
        replies.recv().unwrap();
    })
}

#[test]
#[ignore = "measures for a minute"]
fn latencies_between_hosts() {
    let baseline = sites(2);
    let (udp, put) = (udp(&baseline), zenoh_put(&baseline));
    println!(
        "one way, us: bare UDP p50 {:.0}, p99 {:.0}; bare zenoh put p50 {:.0}, p99 {:.0}",
        udp.0, udp.1, put.0, put.1
    );
    let run = Run::new(&TWO, KEYS, "");
    let hub = run.launch("tcp", &[&["--tick-hz", "200", "--duration", "30"][..], &UNJUDGED].concat());
    let joined = run.join(1, "tcp", None);
    let (_, over) = finish(hub, joined);
    for link in over["hosts"]["links"].as_array().unwrap().iter().filter(|link| link["lossless"] == false) {
        let us = |key: &str| link["one_way"][key].as_f64().unwrap();
        let (service, from, to) = (&link["service"], &link["from"], &link["to"]);
        println!(
            "{service} {from} to {to}: one way, us: p50 {:.0}, p99 {:.0}, max {:.0}",
            us("p50_us"),
            us("p99_us"),
            us("max_us")
        );
    }
    let missed = &over["books"]["missed_ticks"];
    println!(
        "200 Hz, d = 2, 6001 ticks: {missed} missed or starved; first disturbed tick {}",
        over["state"]["first_disturbed_tick"]
    );
    let clock = &over["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let error_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    let track = clock["track"].as_array().unwrap();
    let later_us = track.iter().map(|line| line[1].as_f64().unwrap().abs());
    println!(
        "clock: error {error_us:.1} us at the start, moved by at most {:.1} us since; bound {} us, at most {} us",
        later_us.fold(0.0, f64::max),
        clock["error_us"],
        clock["error_max_us"]
    );
}
