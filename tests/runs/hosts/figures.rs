//! What several hosts cost: figures to be printed, by `cargo test --release --features hosts --test all hosts::figures -- --ignored --nocapture`.

use super::sites::{APART_S, Site, apart, sites};
use super::{KEYS, Run, TWO, UNJUDGED, finish};
use std::net::UdpSocket;
use std::time::{Duration, Instant};
use zenoh::Wait;

/// Round trips of each floor.
const ROUNDS: usize = 2000;
/// The length of what goes round, bytes: as a message with a measurement of `rigid-pair`.
const BYTES: usize = 108;
/// Between two, as at 200 Hz.
const PAUSE: Duration = Duration::from_millis(5);

/// Half of round trips, µs, as p50 and p99.
fn halves(mut round: impl FnMut()) -> (f64, f64) {
    let mut halves: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            std::thread::sleep(PAUSE);
            let sent = Instant::now();
            round();
            sent.elapsed().as_secs_f64() * 5e5
        })
        .collect();
    halves.sort_by(f64::total_cmp);
    (halves[ROUNDS / 2], halves[ROUNDS * 99 / 100])
}

/// A thread in a site's network, until what it does is done.
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
            // An empty one ends it.
            if length == 0 || near.send_to(&bytes[..length], from).is_err() {
                break;
            }
        }
    });
    let mut bytes = [0; BYTES];
    let figures = halves(|| {
        far.send(&bytes).unwrap();
        far.recv(&mut bytes).unwrap();
    });
    far.send(&[]).unwrap();
    figures
}

fn session(mode: &str, side: &str, address: &str) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let endpoints = format!("[\"{address}\"]");
    let none = if side == "listen" { "connect" } else { "listen" };
    for (key, value) in [
        ("mode", format!("\"{mode}\"").as_str()),
        (&format!("{side}/endpoints"), &endpoints),
        (&format!("{none}/endpoints"), "[]"),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// A bare put and its answer: publisher and subscriber as the engine's own example has them, taken from the subscriber's queue.
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
    let heard = far.declare_subscriber("pong").wait().unwrap();
    std::thread::sleep(Duration::from_secs(1));
    halves(|| {
        ping.put(vec![0_u8; BYTES]).wait().unwrap();
        heard.recv().unwrap();
    })
}

#[test]
#[ignore = "it measures, for a minute"]
fn figures() {
    let floors = sites(2);
    let (udp, put) = (udp(&floors), zenoh_put(&floors));
    println!(
        "one way, us: bare UDP p50 {:.0}, p99 {:.0}; bare zenoh put p50 {:.0}, p99 {:.0}",
        udp.0, udp.1, put.0, put.1
    );
    let run = Run::new(&TWO, KEYS, "");
    let launched = run.launch("tcp", &[&["--tick-hz", "200", "--duration", "30"][..], &UNJUDGED].concat());
    let joined = run.join(1, "tcp", None);
    let (_, over) = finish(launched, joined);
    for link in over["hosts"]["links"].as_array().unwrap().iter().filter(|link| link["lossless"] == false) {
        let of = |key: &str| link["one_way"][key].as_f64().unwrap();
        let (service, from, to) = (&link["service"], &link["from"], &link["to"]);
        println!(
            "{service} {from} to {to}: one way, us: p50 {:.0}, p99 {:.0}, max {:.0}",
            of("p50_us"),
            of("p99_us"),
            of("max_us")
        );
    }
    let missed = &over["books"]["missed_ticks"];
    println!(
        "200 Hz, d = 2, 6001 ticks: {missed} missed or starved; first disturbed tick {}",
        over["state"]["first_disturbed_tick"]
    );
    let clock = &over["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let wrong_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    let track = clock["track"].as_array().unwrap();
    let later_us = track.iter().map(|line| line[1].as_f64().unwrap().abs());
    println!(
        "clock: wrong by {wrong_us:.1} us at the start, moved by {:.1} us at most since; known to {} us, at most {} us",
        later_us.fold(0.0, f64::max),
        clock["error_us"],
        clock["error_max_us"]
    );
}
