//! Runs over several hosts, with real processes: on networks and clocks of their own where this user is root, else on loopback.

mod figures;
mod proxy;
mod sites;

use crate::common::{self, Done, await_some, shipped};
use libc::{SIGKILL, SIGTERM};
use proxy::{Impairment, Proxy};
use serde_json::Value;
use sites::{APART_S, Site, apart, free_port, sites};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Every way of them crosses hosts where there are two.
const TWO: [(&str, &[&str]); 2] = [("bench", &["leader", "follower"]), ("flight", &["observer", "controller"])];
const THREE: [(&str, &[&str]); 3] =
    [("bench", &["leader", "follower"]), ("sky", &["observer"]), ("flight", &["controller"])];

/// The pair, with hosts and these keys before its tables.
fn scenario(directory: &Path, hosts: &[(&str, &[&str])], keys: &str, tables: &str) -> PathBuf {
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let table = |(name, roles): &(&str, &[&str])| format!("[[host]]\nname = \"{name}\"\nroles = {roles:?}\n");
    let hosts: String = hosts.iter().map(table).collect();
    let path = directory.join("pair.toml");
    std::fs::write(&path, format!("{keys}\n{text}\n{tables}\n{hosts}")).unwrap();
    path
}

/// A run over sites, the first of which launches.
struct Run {
    sites: Vec<Site>,
    file: PathBuf,
    port: u16,
    hosts: Vec<&'static str>,
}

impl Run {
    /// A host is silent for longer than usual on a loaded machine: where no time is given, that is no silence.
    fn new(hosts: &[(&'static str, &'static [&'static str])], keys: &str, tables: &str) -> Self {
        let sites = sites(hosts.len());
        let patient = "[network]\nsilence_timeout_s = 60.0";
        let tables = match tables {
            "" => patient.to_owned(),
            given if given.contains("silence_timeout_s") => given.to_owned(),
            given => given.replacen("[network]", patient, 1),
        };
        let tables = &tables;
        let file = scenario(&sites[0].bench.path(""), hosts, keys, tables);
        Self { file, port: free_port(), hosts: hosts.iter().map(|(name, _)| *name).collect(), sites }
    }

    fn file(&self) -> &str {
        self.file.to_str().unwrap()
    }

    /// What the first site's scenario comes to in one thread.
    fn alone(&self, arguments: &[&str]) -> Value {
        let done =
            self.sites[0].bench.run(&[&["run", self.file(), "--clock", "in-process", "--json"], arguments].concat());
        done.json()
    }

    fn launch(&self, carrier: &str, arguments: &[&str]) -> common::Running {
        let address = format!("{carrier}/0.0.0.0:{}", self.port);
        let options = ["run", self.file(), "--host", self.hosts[0], "--listen", &address, "--insecure", "--json"];
        self.sites[0].start(&[&options, arguments].concat())
    }

    /// Joins with the site of this number, by another port on the way if that is given.
    fn join(&self, number: usize, carrier: &str, by: Option<u16>) -> common::Running {
        self.await_listening();
        self.join_at_once(number, carrier, by)
    }

    /// Starts a launcher, whether or not a host listens there.
    fn join_at_once(&self, number: usize, carrier: &str, by: Option<u16>) -> common::Running {
        let address = match by {
            Some(port) => format!("{carrier}/127.0.0.1:{port}"),
            None => format!("{carrier}/{}:{}", self.sites[number].hub(), self.port),
        };
        self.sites[number].start(&["join", &address, "--host", self.hosts[number], "--insecure"])
    }

    /// A run in lockstep of these hosts that is ended by a signal only, and whose ticks run.
    fn endless(&self) -> [common::Running; 2] {
        let long = [&["--clock", "lockstep", "--tick-hz", "200", "--duration", "86400"][..], &UNJUDGED].concat();
        let both = [self.launch("tcp", &long), self.join(1, "tcp", None)];
        self.sites[1].bench.await_commits("controller", 1);
        both
    }

    /// Ends such a run.
    fn end(&self, [launched, joined]: [common::Running; 2]) {
        launched.signal(SIGTERM);
        assert_eq!((launched.wait().code, joined.wait().code), (Some(128 + SIGTERM), Some(0)));
        self.assert_clean();
    }

    /// Waits until others can join.
    fn await_listening(&self) {
        await_some(|| {
            let ready = |domain: PathBuf| domain.join("relay.ready").exists();
            self.sites[0].bench.domains().into_iter().any(ready).then_some(())
        });
    }

    fn proxy(&self, number: usize, impairment: Impairment) -> Proxy {
        self.proxy_by(number, impairment, 1 + number as u64)
    }

    fn proxy_by(&self, number: usize, impairment: Impairment, seed: u64) -> Proxy {
        let to = format!("{}:{}", self.sites[number].hub(), self.port).parse().unwrap();
        Proxy::start(&self.sites[number], to, impairment, seed)
    }

    /// Nothing is left on any site.
    fn assert_clean(&self) {
        self.sites.iter().for_each(|site| site.bench.assert_clean(&[]));
    }
}

/// Waits for both; whoever joined ends first, and must have been let in.
fn finish(launched: common::Running, joined: common::Running) -> (Done, Value) {
    joined.wait().succeeded();
    let done = launched.wait();
    let over = done.json();
    (done, over)
}

/// One tick is 5 ms, and a command has two of them.
const KEYS: &str = "actuation_delay_ticks = 2";
const SLOW: [&str; 4] = ["--tick-hz", "200", "--duration", "5"];
/// In real time where the rate does not matter: a loaded machine takes longer than most of a tick of 5 ms, and is refused.
const CALM: [&str; 2] = ["--tick-hz", "50"];
const UNJUDGED: [&str; 2] = ["--set", "accept={}"];

fn run_of(summary: &Value) -> (&str, u64) {
    (summary["state"]["hash"].as_str().unwrap(), summary["books"]["missed_ticks"].as_u64().unwrap())
}

/// Two and three hosts, whose clocks are 1000 s apart: the bits of one thread, recorded in one file.
#[test]
fn lockstep_gives_the_bits_of_one_thread() {
    for hosts in [&TWO[..], &THREE[..]] {
        let budget = if hosts.len() == 3 { "actuation_delay_ticks = 3" } else { KEYS };
        let run = Run::new(hosts, budget, "");
        let arguments = [&SLOW[..], &UNJUDGED].concat();
        let launched =
            run.launch("tcp", &[&arguments[..], &["--clock", "lockstep", "--record", "--out", "over"]].concat());
        let joined: Vec<_> = (1..hosts.len()).map(|number| run.join(number, "tcp", None)).collect();
        let done = launched.wait();
        let over = done.json();
        assert_eq!(done.code, Some(0), "{done:?}");
        joined.into_iter().for_each(|joined| assert_eq!(joined.wait().code, Some(0)));
        let alone = run.alone(&[&arguments[..], &["--record", "--out", "alone"]].concat());
        assert_eq!(run_of(&over), run_of(&alone), "{} hosts", hosts.len());
        assert_eq!(over["books"]["balanced"], true);
        assert_eq!(over["recording"]["complete"], true);
        let here = &run.sites[0].bench;
        for command in [&["diff", "over/run.mcap", "alone/run.mcap"][..], &["replay", "over"], &["report", "over"]] {
            let done = here.run(command);
            assert_eq!(done.code, Some(0), "{command:?}: {done:?}");
        }
        let page = std::fs::read_to_string(here.path("over/report.html")).unwrap();
        assert!(hosts.iter().all(|(name, _)| page.contains(name)), "the page names every host");
        for link in over["hosts"]["links"].as_array().unwrap() {
            assert_eq!((&link["sent"], &link["lost"]), (&link["received"], &Value::from(0)), "{link}");
        }
        run.assert_clean();
    }
}

/// A way that loses, doubles and turns round: in lockstep everything comes all the same.
#[test]
fn lockstep_loses_nothing_on_a_bad_way() {
    let run = Run::new(&TWO, KEYS, "");
    let bad = Impairment { delay_us: 200, jitter_us: 300, lost: 50, doubled: 20, late: 20 };
    let proxy = run.proxy(1, bad);
    let arguments = [&["--tick-hz", "200", "--duration", "2"][..], &UNJUDGED].concat();
    let launched = run.launch("udp", &[&arguments[..], &["--clock", "lockstep"]].concat());
    let joined = run.join(1, "udp", Some(proxy.port));
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&over), run_of(&run.alone(&arguments)));
    assert!(proxy.ill.iter().all(|count| count.load(std::sync::atomic::Ordering::Relaxed) > 0));
    assert!(over["hosts"]["hosts"][0]["repeated_frames"].as_u64().unwrap() > 0, "{}", over["hosts"]);
    run.assert_clean();
}

/// A start survives what a run survives: the handshake, the question, the answer and declarations may be lost.
#[test]
fn every_start_on_a_bad_way_succeeds() {
    const STARTS: usize = 8;
    let arguments = [&["--tick-hz", "200", "--duration", "0.5"][..], &UNJUDGED].concat();
    let mut alone = None;
    for start in 0..STARTS {
        let run = Run::new(&TWO, KEYS, "");
        let bad = Impairment { delay_us: 200, jitter_us: 300, lost: 200, doubled: 100, late: 200 };
        let proxy = run.proxy_by(1, bad, 7 + start as u64);
        let launched = run.launch("udp", &[&arguments[..], &["--clock", "lockstep"]].concat());
        let joined = run.join(1, "udp", Some(proxy.port));
        let (done, over) = finish(launched, joined);
        assert_eq!(done.code, Some(0), "start {start}: {done:?}");
        let alone = alone.get_or_insert_with(|| run.alone(&arguments));
        assert_eq!(run_of(&over), run_of(alone), "start {start}");
        assert!(proxy.ill.iter().all(|count| count.load(std::sync::atomic::Ordering::Relaxed) > 0));
        run.assert_clean();
    }
}

/// The host that is first waits for the other.
#[test]
fn hosts_may_start_in_any_order() {
    let arguments = [&["--tick-hz", "200", "--duration", "0.5", "--clock", "lockstep"][..], &UNJUDGED].concat();
    let pause = std::time::Duration::from_secs(2);
    for carrier in ["tcp", "udp"] {
        for order in ["join first", "at once", "launcher first"] {
            let run = Run::new(&TWO, KEYS, "");
            let joins = |before: std::time::Duration| {
                std::thread::sleep(before);
                run.join_at_once(1, carrier, None)
            };
            let (launched, joined) = match order {
                "join first" => {
                    let joined = joins(std::time::Duration::ZERO);
                    std::thread::sleep(pause);
                    (run.launch(carrier, &arguments), joined)
                }
                "at once" => (run.launch(carrier, &arguments), joins(std::time::Duration::ZERO)),
                _ => (run.launch(carrier, &arguments), joins(pause)),
            };
            let (done, _) = finish(launched, joined);
            assert_eq!(done.code, Some(0), "{carrier}, {order}: {done:?}");
            run.assert_clean();
        }
    }
}

/// A host that joined and is gone before the ticks does not keep the others waiting: they say so, and end.
#[test]
fn a_host_that_joined_and_left_before_the_ticks_ends_the_run() {
    let run = Run::new(&THREE, "actuation_delay_ticks = 3", "[network]\nsilence_timeout_s = 1.5\n");
    let bounded = ["--set", "launch.startup_timeout_s=4", "--clock", "lockstep", UNJUDGED[0], UNJUDGED[1]];
    let launched = run.launch("tcp", &bounded);
    let joined = run.join(1, "tcp", None);
    await_some(|| (!run.sites[1].bench.domains().is_empty()).then_some(()));
    run.sites[1].cut_power();
    assert_eq!(joined.wait().signal, Some(SIGKILL));
    let done = launched.wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    assert!(done.stderr.contains("the host sky") && done.stderr.contains("for 4 s"), "{done:?}");
    // The next run there removes what a power cut leaves.
    let next = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "0.1", UNJUDGED[0], UNJUDGED[1]];
    run.sites[1].bench.run(&next).succeeded();
    run.assert_clean();
}

/// In real time the bits are those of one thread up to the first tick that is missed; the clocks are as far apart as they were set.
#[test]
fn real_time_is_the_same_until_a_tick_is_missed() {
    let run = Run::new(&TWO, KEYS, "");
    let launched = run.launch("tcp", &[&SLOW[..], &UNJUDGED, &["--record", "--out", "over"]].concat());
    let joined = run.join(1, "tcp", None);
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(over["books"]["balanced"], true);
    let clean_ticks = over["state"]["clean_ticks"].as_u64().unwrap();
    if clean_ticks > 0 {
        // The hashes of all ticks on the way are written beside the summary.
        run.alone(&[&SLOW[..], &UNJUDGED, &["--out", "alone"]].concat());
        let hashes = std::fs::read_to_string(run.sites[0].bench.path("alone/hashes.txt")).unwrap();
        let expected = format!("{clean_ticks} {}", over["state"]["clean_hash"].as_str().unwrap());
        assert!(hashes.lines().any(|line| line == expected), "{expected}");
    }
    let clock = &over["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let error_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(error_us <= clock["error_us"].as_f64().unwrap(), "wrong by {error_us} us: {clock}");
    println!("the clock is wrong by {error_us:.1} us: {clock}");
    // And so it is all the time, but for what a correction has still to make up for.
    let slack_us = clock["largest_correction_us"].as_f64().unwrap();
    let track: Vec<[f64; 3]> = serde_json::from_value(clock["track"].clone()).unwrap();
    let start_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns) as f64 / 1e3;
    let wrong = track.iter().map(|[_, since_us, bound_us]| ((start_us + since_us).abs(), *bound_us));
    let largest_us = wrong.clone().map(|(wrong_us, _)| wrong_us).fold(0.0, f64::max);
    assert!(track.len() >= 4 && wrong.clone().all(|(wrong_us, bound_us)| wrong_us <= bound_us + slack_us), "{clock}");
    println!("on the way it is wrong by {largest_us:.1} us at the most");
    let crosses = |link: &&Value| link["one_way"].is_object() && link["lossless"] == false;
    assert_eq!(over["hosts"]["links"].as_array().unwrap().iter().filter(crosses).count(), 3);
    assert!(over["recording"]["complete"] == true, "{}", over["recording"]);
    run.assert_clean();
}

/// Of 20 samples one is lost, others are doubled and late: the books of both ends tell, and the declared bound holds.
#[test]
fn losses_are_counted_and_the_bound_holds() {
    let accept = [
        "--set",
        "accept={sync_error_rad_s_peak=0.05,peak_from_s=3,missed_ticks_max={},starved_ticks_max={},safe_ticks_max={},unscored_ticks_max=\"50 %\"}",
        "--tick-hz",
        "200",
        "--duration",
        "6",
    ];
    let run = Run::new(&TWO, "actuation_delay_ticks = 4", "[network]\nbudget_ticks = 2\n");
    let bad = Impairment { delay_us: 300, jitter_us: 300, lost: 50, doubled: 20, late: 20 };
    let proxy = run.proxy(1, bad);
    let launched = run.launch("udp", &[&accept[..], &["--record"]].concat());
    let joined = run.join(1, "udp", Some(proxy.port));
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!((&over["accepted"], &over["books"]["balanced"]), (&Value::from(true), &Value::from(true)));
    let links = over["hosts"]["links"].as_array().unwrap();
    let lost: u64 = links.iter().map(|link| link["lost"].as_u64().unwrap()).sum();
    assert!(lost > 20, "{links:?}");
    for link in links {
        let count = |key: &str| link[key].as_u64().unwrap();
        assert_eq!(count("sent"), count("received") + count("lost"), "{link}");
        assert!(link["lossless"] == false || count("lost") == 0, "{link}");
    }
    // A sample that was lost on the way is missing at its reader, and nothing else is.
    let gaps: u64 = over["books"]["links"].as_array().unwrap().iter().map(|link| link["gaps"].as_u64().unwrap()).sum();
    assert!(gaps > 0);
    run.assert_clean();
}

/// A way that is cut for a second and joined again: plants hold and go safe by themselves, and the run goes on.
#[test]
fn a_cut_of_a_second_is_told_and_outlived() {
    let run = Run::new(&TWO, KEYS, "");
    let (done, joined) = cut(&run, std::time::Duration::from_secs(1), &[]);
    let over = done.json();
    assert_eq!((done.code, joined.code), (Some(0), Some(0)), "{done:?} {joined:?}");
    let silences = over["hosts"]["hosts"][0]["silences"].as_array().unwrap();
    assert!(silences.iter().all(|silence| silence["of"] == "flight" && silence["healed"] == true), "{silences:?}");
    // On a loaded machine there are shorter ones beside that of the cut.
    assert!(silences.iter().any(|silence| silence["seconds"].as_f64().unwrap() >= 0.7), "{silences:?}");
    assert!(over["books"]["roles"]["follower"]["safe"].as_u64().unwrap() > 0, "the follower goes safe by itself");
    let last = over["books"]["roles"]["follower"]["elapsed"].as_u64().unwrap();
    assert_eq!(last, over["last_tick"].as_u64().unwrap() + 1);
    run.assert_clean();
}

/// A cut of ten seconds is longer than the scenario allows: the run ends in order on both sides, and both say what they saw.
#[test]
fn a_cut_beyond_the_limit_ends_the_run_in_order() {
    let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 2.0\n");
    let (done, joined) = cut(&run, std::time::Duration::from_secs(10), &[]);
    assert_eq!((done.code, joined.code), (Some(4), Some(4)), "{done:?} {joined:?}");
    let over = done.json();
    let cause = over["incidents"][0]["cause"].as_str().unwrap();
    assert!(cause.contains("the host flight for 2 s"), "{cause}");
    assert!(joined.stderr.contains("nothing was heard of the host bench for 2 s"), "{}", joined.stderr);
    run.assert_clean();
}

/// The same cut where the scenario allows for it: the run goes on once it heals.
#[test]
fn a_cut_within_the_limit_heals() {
    let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 60.0\n");
    let (done, joined) = cut(&run, std::time::Duration::from_secs(10), &["--duration", "20"]);
    assert_eq!((done.code, joined.code), (Some(0), Some(0)), "{done:?} {joined:?}");
    let over = done.json();
    let silences = over["hosts"]["hosts"][0]["silences"].as_array().unwrap();
    assert!(silences.iter().any(|silence| silence["seconds"].as_f64().unwrap() >= 9.0), "{silences:?}");
    let hold = over["books"]["roles"]["follower"]["safe"].as_u64().unwrap();
    assert!(hold > 375, "{hold}");
    run.assert_clean();
}

/// Runs in real time over a way that is cut for so long once ticks run.
fn cut(run: &Run, length: std::time::Duration, arguments: &[&str]) -> (Done, Done) {
    let proxy = run.proxy(1, Impairment { delay_us: 100, ..Impairment::default() });
    let duration = if arguments.is_empty() { &["--duration", "16"][..] } else { arguments };
    let mut launched = run.launch("udp", &[&CALM[..], &UNJUDGED, duration].concat());
    let joined = run.join(1, "udp", Some(proxy.port));
    await_some(|| (run.sites[1].bench.commits("controller") >= 20 || launched.has_ended()).then_some(()));
    proxy.cut(true);
    std::thread::sleep(length);
    proxy.cut(false);
    let joined = joined.wait();
    (launched.wait(), joined)
}

/// Whoever vanishes, the other side says so, ends in order and leaves nothing.
#[test]
fn a_host_that_vanishes_ends_the_run_of_the_others() {
    for vanishing in [0, 1] {
        let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 1.5\n");
        let launched = run.launch("tcp", &[&CALM[..], &["--duration", "60"], &UNJUDGED].concat());
        let joined = run.join(1, "tcp", None);
        run.sites[1].bench.await_commits("controller", 100);
        run.sites[vanishing].cut_power();
        let (launched, joined) = (launched.wait(), joined.wait());
        if vanishing == 1 {
            let cause = launched.json()["incidents"][0]["cause"].as_str().unwrap().to_owned();
            assert!(cause.contains("nothing was heard of it and the host flight for 1.5 s"), "{cause}");
            assert_eq!((launched.code, joined.signal), (Some(4), Some(SIGKILL)));
        } else {
            assert_eq!((launched.signal, joined.code), (Some(SIGKILL), Some(4)), "{joined:?}");
            assert!(joined.stderr.contains("nothing was heard of the host bench for 1.5 s"), "{}", joined.stderr);
        }
        run.sites[1 - vanishing].bench.assert_clean(&[]);
        // The next run there removes what a power cut leaves.
        run.sites[vanishing]
            .bench
            .run(&["run", "rigid-pair", "--clock", "lockstep", "--duration", "0.1", UNJUDGED[0], UNJUDGED[1]])
            .succeeded();
        run.assert_clean();
    }
}

/// A role that dies, wherever it is, is started again there and goes on where it was: in lockstep that costs not a bit.
#[test]
fn a_role_that_dies_on_any_host_costs_nothing_in_lockstep() {
    let run = Run::new(&TWO, KEYS, "");
    let long = [&["--tick-hz", "200", "--duration", "150"][..], &UNJUDGED].concat();
    let launched = run.launch("tcp", &[&long[..], &["--clock", "lockstep"]].concat());
    let joined = run.join(1, "tcp", None);
    run.sites[1].bench.await_commits("controller", 100);
    let dead = [(1, "controller"), (1, "observer"), (0, "follower"), (0, "leader")];
    for (site, role) in dead {
        let bench = &run.sites[site].bench;
        common::send_signal(bench.await_role(role), SIGKILL);
        // The next one while this is being brought back would be another test.
        let before = bench.commits(role);
        bench.await_commits(role, before + 100);
    }
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&over), run_of(&run.alone(&long)));
    let mut told: Vec<&str> =
        over["incidents"].as_array().unwrap().iter().map(|one| one["role"].as_str().unwrap()).collect();
    told.sort_unstable();
    assert_eq!(told, ["controller", "follower", "leader", "observer"]);
    run.assert_clean();
}

/// Without a relay a host is alone: on whichever side it dies, both end in order and say so.
#[test]
fn a_relay_that_dies_ends_the_run_in_order() {
    for side in [0, 1] {
        let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 1.5\n");
        let launched = run.launch("tcp", &[&CALM[..], &["--duration", "60"], &UNJUDGED].concat());
        let joined = run.join(1, "tcp", None);
        run.sites[1].bench.await_commits("controller", 100);
        common::send_signal(run.sites[side].bench.await_role("relay"), SIGKILL);
        let (launched, joined) = (launched.wait(), joined.wait());
        assert_eq!((launched.code, joined.code), (Some(4), Some(4)), "{launched:?} {joined:?}");
        let causes = launched.json()["incidents"].to_string();
        let expected = if side == 0 { "relay" } else { "the host flight" };
        assert!(causes.contains(expected), "{causes}");
        run.assert_clean();
    }
}

/// Where the machines keep CLOCK_TAI alike, as these do who share it, that is the time.
#[test]
fn the_system_s_clock_is_taken_where_it_is_kept() {
    let run = Run::new(&TWO, KEYS, "[network]\nclock_source = \"system\"\n");
    let launched = run.launch("tcp", &[&["--tick-hz", "200", "--duration", "2"][..], &UNJUDGED].concat());
    let joined = run.join(1, "tcp", None);
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    let clock = &over["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let wrong_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(clock["source"] == "system" && wrong_us <= clock["error_us"].as_f64().unwrap(), "{wrong_us} us: {clock}");
    println!("by CLOCK_TAI the clock is wrong by {wrong_us:.2} us");
    run.assert_clean();
}

/// What is wrong with a host that wants to join is told by name, to it alone.
#[test]
fn who_does_not_belong_is_told_why() {
    let run = Run::new(&TWO, KEYS, "");
    let both = run.endless();
    let address = format!("tcp/{}:{}", run.sites[1].hub(), run.port);
    let stranger = run.sites[1].start(&["join", &address, "--host", "moon", "--insecure"]).wait();
    assert_eq!(stranger.code, Some(2), "{stranger:?}");
    assert!(stranger.stderr.contains("no host `moon` joins this run; it waits for: flight"), "{}", stranger.stderr);
    let hub = run.sites[1].start(&["join", &address, "--host", "bench", "--insecure"]).wait();
    assert!(hub.stderr.contains("no host `bench` joins this run"), "{}", hub.stderr);
    let probe = run.sites[1].start(&["doctor", "--link", &address, "--insecure", "--seconds", "1", "--json"]).wait();
    let probe = probe.json();
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let wrong_us = (probe["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(wrong_us <= probe["error_us"].as_f64().unwrap(), "wrong by {wrong_us} us: {probe}");
    let second = run.sites[1].start(&["join", &address, "--insecure"]).wait();
    assert!(second.stderr.contains("has joined already"), "{}", second.stderr);
    run.end(both);
}

/// What shows or records a run is refused where a host has joined, and sees all of it where it was launched.
#[test]
fn a_run_is_looked_at_where_it_was_launched() {
    let run = Run::new(&TWO, KEYS, "");
    let both = run.endless();
    let domain = run.sites[1].bench.domains().remove(0);
    for command in [&["watch"][..], &["record", "--domain"], &["foxglove"]] {
        let refused = run.sites[1].start(&[command, &[domain.to_str().unwrap()]].concat()).wait();
        assert!(refused.code == Some(2) && refused.says("partial-run"), "{refused:?}");
    }
    let domain = run.sites[0].bench.domains().remove(0);
    let watched = run.sites[0].start(&["watch", domain.to_str().unwrap(), "--once", "0.5"]).wait();
    assert!(watched.code == Some(0) && watched.stdout.contains("controller"), "{watched:?}");
    run.end(both);
}

/// What is open to everybody is so only if it was said, and only with a scenario that has hosts.
#[test]
fn nothing_is_open_by_mistake() {
    let run = Run::new(&TWO, KEYS, "");
    let refused = |arguments: &[&str], expected: &str| {
        let done = run.sites[0].bench.run(arguments);
        assert_eq!(done.code, Some(2), "{arguments:?}: {done:?}");
        assert!(done.stderr.contains(expected), "{arguments:?}: {}", done.stderr);
    };
    let run_with = |options: &[&'static str]| [&["run", run.file()], options].concat();
    refused(&run_with(&["--host", "bench", "--listen", "tcp/0.0.0.0:1"]), "is open to everybody who reaches it");
    refused(
        &run_with(&["--host", "bench", "--listen", "quic/127.0.0.1:1"]),
        "needs --tls-ca, --tls-cert and --tls-key",
    );
    refused(&run_with(&["--host", "moon", "--listen", "tcp/127.0.0.1:1"]), "no such host; it has: bench, flight");
    refused(&run_with(&["--host", "bench"]), "--listen");
    refused(&["run", "rigid-pair", "--host", "bench", "--listen", "tcp/127.0.0.1:1"], "has no [[host]]");
    refused(&["join", "tcp/192.0.2.1:1"], "is open to everybody who reaches it");
    refused(&["join", "tls/192.0.2.1:1"], "write quic/HOST:PORT");
    run.assert_clean();
}

/// An authority, and a key that it has signed for each of these names and addresses.
fn make_keys(directory: &Path, authority: &str, hosts: &[(&str, &str)]) {
    let openssl = |words: &[&str]| {
        let done = Command::new("openssl").args(words).current_dir(directory).output().unwrap();
        assert!(done.status.success(), "{words:?}: {}", String::from_utf8_lossy(&done.stderr));
    };
    let of = |name: &str, kind: &str| format!("{name}.{kind}");
    let new = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-noenc", "-days", "30"];
    let (ca, ca_key) = (of(authority, "pem"), of(authority, "key"));
    let subject = format!("/CN={authority}");
    openssl(&[&["req", "-x509"][..], &new, &["-keyout", &ca_key, "-out", &ca, "-subj", &subject]].concat());
    for (host, address) in hosts {
        let (cert, key) = (of(host, "pem"), of(host, "key"));
        let (subject, names) = (format!("/CN={host}"), format!("subjectAltName=IP:{address},DNS:{host}"));
        let signed =
            ["-CA", &ca, "-CAkey", &ca_key, "-keyout", &key, "-out", &cert, "-subj", &subject, "-addext", &names];
        let leaf = ["-addext", "basicConstraints=critical,CA:FALSE"];
        openssl(&[&["req", "-x509"][..], &new, &signed, &leaf].concat());
    }
}

/// Over QUIC both sides show who they are: who has no key, or one of another authority, neither joins nor hears anything.
#[test]
fn a_stranger_neither_joins_nor_injects() {
    let run = Run::new(&TWO, KEYS, "");
    let (keys, hub) = (run.sites[0].bench.path("keys"), run.sites[1].hub());
    std::fs::create_dir(&keys).unwrap();
    make_keys(&keys, "ours", &[("bench", &hub), ("flight", "127.0.0.1")]);
    make_keys(&keys, "theirs", &[("stranger", "127.0.0.1")]);
    let path = |name: &str| keys.join(name).to_str().unwrap().to_owned();
    let options = |ca: &str, host: &str| {
        let [ca, cert, key] =
            [format!("{ca}.pem"), format!("{host}.pem"), format!("{host}.key")].map(|name| path(&name));
        ["--tls-ca".to_owned(), ca, "--tls-cert".to_owned(), cert, "--tls-key".to_owned(), key]
    };
    let address = format!("quic/{hub}:{}", run.port);
    let start = |site: &Site, words: &[&str], options: &[String]| {
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        site.start(&[words, &options].concat())
    };
    let words = ["run", run.file(), "--clock", "lockstep", "--json", "--host", "bench", "--listen", &address];
    let launched = start(&run.sites[0], &[&words[..], &SLOW, &UNJUDGED].concat(), &options("ours", "bench"));
    run.await_listening();
    let plain = run.sites[1].start(&["join", &address.replace("quic/", "tcp/"), "--insecure"]).wait();
    assert_eq!(plain.code, Some(1), "{plain:?}");
    for (ca, host) in [("theirs", "stranger"), ("ours", "stranger"), ("theirs", "flight")] {
        let refused = start(&run.sites[1], &["join", &address], &options(ca, host)).wait();
        assert_eq!(refused.code, Some(1), "{ca} {host}: {refused:?}");
        assert!(refused.stderr.contains("has one authority signed the keys of both"), "{}", refused.stderr);
    }
    let joined = start(&run.sites[1], &["join", &address], &options("ours", "flight"));
    let (done, over) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&over), run_of(&run.alone(&[&SLOW[..], &UNJUDGED].concat())));
    assert_eq!(over["hosts"]["hosts"][0]["malformed"], 0);
    run.assert_clean();
}
