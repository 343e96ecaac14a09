//! Runs over several hosts, with real processes. If this user is root, hosts have their own networks and clocks; otherwise they share
//! loopback.

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
use std::sync::{Condvar, Mutex, PoisonError};

/// The plants on one host, observer and controller on another: every signal of the loop crosses.
const TWO: [(&str, &[&str]); 2] = [("bench", &["leader", "follower"]), ("flight", &["observer", "controller"])];
const THREE: [(&str, &[&str]); 3] =
    [("bench", &["leader", "follower"]), ("sky", &["observer"]), ("flight", &["controller"])];

/// Writes the scenario `rigid-pair` with hosts, `keys` before its tables and `tables` after them.
fn scenario(directory: &Path, hosts: &[(&str, &[&str])], keys: &str, tables: &str) -> PathBuf {
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let table = |(name, roles): &(&str, &[&str])| format!("[[host]]\nname = \"{name}\"\nroles = {roles:?}\n");
    let hosts: String = hosts.iter().map(table).collect();
    let path = directory.join("pair.toml");
    std::fs::write(&path, format!("{keys}\n{text}\n{tables}\n{hosts}")).unwrap();
    path
}

/// A run over several sites; the first one launches it.
struct Run {
    sites: Vec<Site>,
    file: PathBuf,
    port: u16,
    hosts: Vec<&'static str>,
    _turn: Turn,
}

/// The number of runs at present. Each has nine processes or more: more runs than cores miss their limits in real time.
static RUNS: (Mutex<usize>, Condvar) = (Mutex::new(0), Condvar::new());

/// A run's turn, which others wait for.
struct Turn;

impl Turn {
    fn take() -> Self {
        let most = std::thread::available_parallelism().map_or(2, usize::from);
        let runs = RUNS.0.lock().unwrap_or_else(PoisonError::into_inner);
        *RUNS.1.wait_while(runs, |runs| *runs >= most).unwrap_or_else(PoisonError::into_inner) += 1;
        Self
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        *RUNS.0.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        RUNS.1.notify_one();
    }
}

impl Run {
    /// Without a `silence_timeout_s` in `tables` the timeout is long, because hosts are silent for longer on a loaded machine.
    fn new(hosts: &[(&'static str, &'static [&'static str])], keys: &str, tables: &str) -> Self {
        let turn = Turn::take();
        let sites = sites(hosts.len());
        let long = "[network]\nsilence_timeout_s = 60.0";
        let tables = match tables {
            "" => long.to_owned(),
            tables if tables.contains("silence_timeout_s") => tables.to_owned(),
            tables => tables.replacen("[network]", long, 1),
        };
        let tables = &tables;
        let file = scenario(&sites[0].bench.path(""), hosts, keys, tables);
        let hosts = hosts.iter().map(|(name, _)| *name).collect();
        Self { file, port: free_port(), hosts, sites, _turn: turn }
    }

    fn file(&self) -> &str {
        self.file.to_str().unwrap()
    }

    /// Runs the scenario in one thread; returns the summary.
    fn in_process(&self, arguments: &[&str]) -> Value {
        let done =
            self.sites[0].bench.run(&[&["run", self.file(), "--clock", "in-process", "--json"], arguments].concat());
        done.json()
    }

    fn launch(&self, carrier: &str, arguments: &[&str]) -> common::Running {
        let address = format!("{carrier}/0.0.0.0:{}", self.port);
        let options = ["run", self.file(), "--host", self.hosts[0], "--listen", &address, "--insecure", "--json"];
        self.sites[0].start(&[&options, arguments].concat())
    }

    /// Joins from the site of this number once the launching host listens; through a local proxy on port `by`, if any.
    fn join(&self, number: usize, carrier: &str, by: Option<u16>) -> common::Running {
        self.await_listening();
        self.join_at_once(number, carrier, by)
    }

    /// Joins from the site of this number without waiting for the launching host.
    fn join_at_once(&self, number: usize, carrier: &str, by: Option<u16>) -> common::Running {
        let address = match by {
            Some(port) => format!("{carrier}/127.0.0.1:{port}"),
            None => format!("{carrier}/{}:{}", self.sites[number].hub(), self.port),
        };
        self.sites[number].start(&["join", &address, "--host", self.hosts[number], "--insecure"])
    }

    /// Starts a lockstep run that only a signal ends, and waits for its first ticks.
    fn endless(&self) -> [common::Running; 2] {
        let long = [&["--clock", "lockstep", "--tick-hz", "200", "--duration", "86400"][..], &UNJUDGED].concat();
        let both = [self.launch("tcp", &long), self.join(1, "tcp", None)];
        self.sites[1].bench.await_commits("controller", 1);
        both
    }

    /// Ends a run started by `endless`.
    fn end(&self, [launched, joined]: [common::Running; 2]) {
        launched.signal(SIGTERM);
        assert_eq!((launched.wait().code, joined.wait().code), (Some(128 + SIGTERM), Some(0)));
        self.assert_clean();
    }

    /// Waits until the launching host listens.
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

    /// Asserts that no site has leftover files or processes.
    fn assert_clean(&self) {
        self.sites.iter().for_each(|site| site.bench.assert_clean(&[]));
    }
}

/// Waits for both processes; the joined one must succeed. Returns the launching one's output and summary.
fn finish(launched: common::Running, joined: common::Running) -> (Done, Value) {
    joined.wait().succeeded();
    let done = launched.wait();
    let summary = done.json();
    (done, summary)
}

/// A command may take two ticks.
const KEYS: &str = "actuation_delay_ticks = 2";
const SLOW: [&str; 4] = ["--tick-hz", "200", "--duration", "5"];
/// The rate of real-time tests where it does not matter: on a loaded machine a message takes most of 5 ms, and the host is refused.
const CALM: [&str; 2] = ["--tick-hz", "50"];
const UNJUDGED: [&str; 2] = ["--set", "accept={}"];

fn run_of(summary: &Value) -> (&str, u64) {
    (summary["state"]["hash"].as_str().unwrap(), summary["books"]["missed_ticks"].as_u64().unwrap())
}

/// The hosts' clocks differ by 1000 s. The run is recorded in one file.
#[test]
fn lockstep_over_two_and_three_hosts_equals_one_thread() {
    for hosts in [&TWO[..], &THREE[..]] {
        let budget = if hosts.len() == 3 { "actuation_delay_ticks = 3" } else { KEYS };
        let run = Run::new(hosts, budget, "");
        let arguments = [&SLOW[..], &UNJUDGED].concat();
        let launched =
            run.launch("tcp", &[&arguments[..], &["--clock", "lockstep", "--record", "--out", "over"]].concat());
        let joined: Vec<_> = (1..hosts.len()).map(|number| run.join(number, "tcp", None)).collect();
        let done = launched.wait();
        let summary = done.json();
        assert_eq!(done.code, Some(0), "{done:?}");
        joined.into_iter().for_each(|joined| assert_eq!(joined.wait().code, Some(0)));
        let alone = run.in_process(&[&arguments[..], &["--record", "--out", "alone"]].concat());
        assert_eq!(run_of(&summary), run_of(&alone), "{} hosts", hosts.len());
        assert_eq!(summary["books"]["balanced"], true);
        assert_eq!(summary["recording"]["complete"], true);
        let here = &run.sites[0].bench;
        for command in [&["diff", "over/run.mcap", "alone/run.mcap"][..], &["replay", "over"], &["report", "over"]] {
            let done = here.run(command);
            assert_eq!(done.code, Some(0), "{command:?}: {done:?}");
        }
        let page = std::fs::read_to_string(here.path("over/report.html")).unwrap();
        assert!(hosts.iter().all(|(name, _)| page.contains(name)), "the page names every host");
        for link in summary["hosts"]["links"].as_array().unwrap() {
            assert_eq!((&link["sent"], &link["lost"]), (&link["received"], &Value::from(0)), "{link}");
        }
        run.assert_clean();
    }
}

/// Changes that arrive while the loop runs act at the same tick on every host, also if messages are lost.
#[test]
fn live_changes_reach_every_host() {
    for clock in ["lockstep", "realtime"] {
        let run = Run::new(&TWO, KEYS, "");
        let bad = Impairment { delay_us: 200, jitter_us: 300, lost: 50, doubled: 20, late: 20 };
        let proxy = run.proxy(1, bad);
        let here = &run.sites[0].bench;
        let arguments = ["--tick-hz", "50", "--duration", "86400", "--clock", clock, "--record", "--out", "over"];
        let launched = run.launch("udp", &[&arguments[..], &UNJUDGED].concat());
        let joined = run.join(1, "udp", Some(proxy.port));
        run.sites[1].bench.await_commits("controller", 10);
        let mut ticks = Vec::new();
        for gain in [3.0, 4.0, 5.0] {
            // The controller and the observer are on the other host, the follower that is disturbed is here.
            let changes = [
                format!("controller.gain_per_s=[{gain:?},{gain:?},{gain:?}]"),
                format!("observer.decay_rate_per_s={gain:?}"),
                format!("follower.0.disturbance_rad_s2=[0.0,{:?},0.0]", gain / 1000.0),
            ];
            let set = [&["set", "over", "--force", "--json"][..], &changes.each_ref().map(String::as_str)].concat();
            ticks.push(here.run(&set).succeeded().json()["tick"].as_u64().unwrap());
            run.sites[1].bench.await_commits("controller", ticks[ticks.len() - 1] + 10);
        }
        assert!(ticks.is_sorted());
        launched.signal(SIGTERM);
        let done = launched.wait();
        assert_eq!((done.code, joined.wait().code), (Some(128 + SIGTERM), Some(0)), "{done:?}");
        let replayed = here.run(&["replay", "over", "--json"]).succeeded();
        println!("{clock}: changed at {ticks:?}; {}", replayed.stdout);
        run.assert_clean();
    }
}

#[test]
fn lockstep_over_a_lossy_connection_equals_one_thread() {
    let run = Run::new(&TWO, KEYS, "");
    let bad = Impairment { delay_us: 200, jitter_us: 300, lost: 50, doubled: 20, late: 20 };
    let proxy = run.proxy(1, bad);
    let arguments = [&["--tick-hz", "200", "--duration", "2"][..], &UNJUDGED].concat();
    let launched = run.launch("udp", &[&arguments[..], &["--clock", "lockstep"]].concat());
    let joined = run.join(1, "udp", Some(proxy.port));
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&summary), run_of(&run.in_process(&arguments)));
    assert!(proxy.impaired.iter().all(|count| count.load(std::sync::atomic::Ordering::Relaxed) > 0));
    assert!(summary["hosts"]["hosts"][0]["repeated_frames"].as_u64().unwrap() > 0, "{}", summary["hosts"]);
    run.assert_clean();
}

/// Handshake, request, answer and declarations may be lost.
#[test]
fn every_start_over_a_lossy_connection_succeeds() {
    const STARTS: usize = 8;
    let arguments = [&["--tick-hz", "200", "--duration", "0.5"][..], &UNJUDGED].concat();
    let mut alone = None;
    for start in 0..STARTS {
        let run = Run::new(&TWO, KEYS, "");
        let bad = Impairment { delay_us: 200, jitter_us: 300, lost: 200, doubled: 100, late: 200 };
        let proxy = run.proxy_by(1, bad, 7 + start as u64);
        let launched = run.launch("udp", &[&arguments[..], &["--clock", "lockstep"]].concat());
        let joined = run.join(1, "udp", Some(proxy.port));
        let (done, summary) = finish(launched, joined);
        assert_eq!(done.code, Some(0), "start {start}: {done:?}");
        let alone = alone.get_or_insert_with(|| run.in_process(&arguments));
        assert_eq!(run_of(&summary), run_of(alone), "start {start}");
        assert!(proxy.impaired.iter().all(|count| count.load(std::sync::atomic::Ordering::Relaxed) > 0));
        run.assert_clean();
    }
}

#[test]
fn hosts_may_start_in_any_order() {
    let arguments = [&["--tick-hz", "200", "--duration", "0.5", "--clock", "lockstep"][..], &UNJUDGED].concat();
    let pause = std::time::Duration::from_secs(2);
    for carrier in ["tcp", "udp"] {
        for order in ["join first", "at once", "launcher first"] {
            let run = Run::new(&TWO, KEYS, "");
            let joins = |delay: std::time::Duration| {
                std::thread::sleep(delay);
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

#[test]
fn a_joined_host_that_is_lost_before_the_ticks_ends_the_run() {
    let run = Run::new(&THREE, "actuation_delay_ticks = 3", "[network]\nsilence_timeout_s = 1.5\n");
    let bounded = ["--set", "launch.startup_timeout_s=4", "--clock", "lockstep", UNJUDGED[0], UNJUDGED[1]];
    let launched = run.launch("tcp", &bounded);
    let joined = run.join(1, "tcp", None);
    await_some(|| (!run.sites[1].bench.domains().is_empty()).then_some(()));
    run.sites[1].cut_power();
    assert_eq!(joined.wait().signal, Some(SIGKILL));
    let done = launched.wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    let is_reason = |line: &str| line.contains("sky") && line.contains("4 s") && line.ends_with(']');
    assert!(done.stderr.lines().any(is_reason), "{done:?}");
    // The next run on that site removes the files that the power cut left.
    let next = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "0.1", UNJUDGED[0], UNJUDGED[1]];
    run.sites[1].bench.run(&next).succeeded();
    run.assert_clean();
}

/// Also checks the estimated clock offset.
#[test]
fn real_time_equals_one_thread_until_the_first_missed_tick() {
    let run = Run::new(&TWO, KEYS, "");
    let launched = run.launch("tcp", &[&SLOW[..], &UNJUDGED, &["--record", "--out", "over"]].concat());
    let joined = run.join(1, "tcp", None);
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(summary["books"]["balanced"], true);
    let clean_ticks = summary["state"]["clean_ticks"].as_u64().unwrap();
    if clean_ticks > 0 {
        // `hashes.txt` has the state hash of every tick.
        run.in_process(&[&SLOW[..], &UNJUDGED, &["--out", "alone"]].concat());
        let hashes = std::fs::read_to_string(run.sites[0].bench.path("alone/hashes.txt")).unwrap();
        let expected = format!("{clean_ticks} {}", summary["state"]["clean_hash"].as_str().unwrap());
        assert!(hashes.lines().any(|line| line == expected), "{expected}");
    }
    let clock = &summary["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let error_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(error_us <= clock["error_us"].as_f64().unwrap(), "error {error_us} us: {clock}");
    println!("clock error {error_us:.1} us: {clock}");
    // The bound holds during the whole run, except for the part that a correction has not removed yet.
    let slack_us = clock["largest_correction_us"].as_f64().unwrap();
    let track: Vec<[f64; 3]> = serde_json::from_value(clock["track"].clone()).unwrap();
    let start_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns) as f64 / 1e3;
    let errors = track.iter().map(|[_, since_us, bound_us]| ((start_us + since_us).abs(), *bound_us));
    let largest_us = errors.clone().map(|(error_us, _)| error_us).fold(0.0, f64::max);
    assert!(track.len() >= 4 && errors.clone().all(|(error_us, bound_us)| error_us <= bound_us + slack_us), "{clock}");
    println!("largest clock error during the run {largest_us:.1} us");
    let crosses = |link: &&Value| link["one_way"].is_object() && link["lossless"] == false;
    assert_eq!(summary["hosts"]["links"].as_array().unwrap().iter().filter(crosses).count(), 3);
    assert!(summary["recording"]["complete"] == true, "{}", summary["recording"]);
    run.assert_clean();
}

/// One sample of 20 is lost, others are doubled or late.
#[test]
fn both_ends_count_losses_and_the_run_meets_its_limits() {
    let accept = [
        "--set",
        "accept={sync_error_rad_s_peak=0.05,peak_from_s=3,missed_ticks_max={},starved_ticks_max={},safe_ticks_max={},unscored_ticks_max=\"50 %\"}",
        "--tick-hz",
        "100",
        "--duration",
        "6",
    ];
    let run = Run::new(&TWO, "actuation_delay_ticks = 4", "[network]\nbudget_ticks = 2\n");
    let bad = Impairment { delay_us: 300, jitter_us: 300, lost: 50, doubled: 20, late: 20 };
    let proxy = run.proxy(1, bad);
    let launched = run.launch("udp", &[&accept[..], &["--record"]].concat());
    let joined = run.join(1, "udp", Some(proxy.port));
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!((&summary["accepted"], &summary["books"]["balanced"]), (&Value::from(true), &Value::from(true)));
    let links = summary["hosts"]["links"].as_array().unwrap();
    let lost: u64 = links.iter().map(|link| link["lost"].as_u64().unwrap()).sum();
    assert!(lost > 20, "{links:?}");
    for link in links {
        let count = |key: &str| link[key].as_u64().unwrap();
        assert_eq!(count("sent"), count("received") + count("lost"), "{link}");
        assert!(link["lossless"] == false || count("lost") == 0, "{link}");
    }
    // A lost sample is a gap at its reader.
    let gaps: u64 =
        summary["books"]["links"].as_array().unwrap().iter().map(|link| link["gaps"].as_u64().unwrap()).sum();
    assert!(gaps > 0);
    run.assert_clean();
}

#[test]
fn an_interruption_of_one_second_is_reported_and_the_run_goes_on() {
    let run = Run::new(&TWO, KEYS, "");
    let (done, joined) = interrupt(&run, std::time::Duration::from_secs(1), &[]);
    let summary = done.json();
    assert_eq!((done.code, joined.code), (Some(0), Some(0)), "{done:?} {joined:?}");
    let silences = summary["hosts"]["hosts"][0]["silences"].as_array().unwrap();
    assert!(silences.iter().all(|silence| silence["of"] == "flight" && silence["healed"] == true), "{silences:?}");
    // On a loaded machine there are shorter silences as well.
    assert!(silences.iter().any(|silence| silence["seconds"].as_f64().unwrap() >= 0.7), "{silences:?}");
    assert!(
        summary["books"]["roles"]["follower"]["safe"].as_u64().unwrap() > 0,
        "the follower applies its safe command"
    );
    let last = summary["books"]["roles"]["follower"]["elapsed"].as_u64().unwrap();
    assert_eq!(last, summary["last_tick"].as_u64().unwrap() + 1);
    run.assert_clean();
}

/// Codes of the incident of a lost host: the launcher's timeout, or the report of the host.
const LOST: [&str; 2] = ["host-silent", "host-left"];

#[test]
fn an_interruption_beyond_the_timeout_ends_the_run_on_both_sides() {
    let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 2.0\n");
    let (done, joined) = interrupt(&run, std::time::Duration::from_secs(10), &[]);
    assert_eq!((done.code, joined.code), (Some(4), Some(4)), "{done:?} {joined:?}");
    let summary = done.json();
    let (code, cause) = (&summary["incidents"][0]["code"], summary["incidents"][0]["cause"].as_str().unwrap());
    assert!(
        code.as_str().is_some_and(|code| LOST.contains(&code)) && cause.contains("flight") && cause.contains("2 s"),
        "{code}: {cause}"
    );
    assert!(joined.says("run-failed") && joined.stderr.contains("2 s"), "{}", joined.stderr);
    run.assert_clean();
}

#[test]
fn an_interruption_within_the_timeout_is_survived() {
    let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 60.0\n");
    let (done, joined) = interrupt(&run, std::time::Duration::from_secs(10), &["--duration", "20"]);
    assert_eq!((done.code, joined.code), (Some(0), Some(0)), "{done:?} {joined:?}");
    let summary = done.json();
    let silences = summary["hosts"]["hosts"][0]["silences"].as_array().unwrap();
    assert!(silences.iter().any(|silence| silence["seconds"].as_f64().unwrap() >= 9.0), "{silences:?}");
    let hold = summary["books"]["roles"]["follower"]["safe"].as_u64().unwrap();
    assert!(hold > 375, "{hold}");
    run.assert_clean();
}

/// Runs in real time over a connection that is interrupted for `length` once ticks run. Returns both processes' output.
fn interrupt(run: &Run, length: std::time::Duration, arguments: &[&str]) -> (Done, Done) {
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

#[test]
fn a_power_cut_on_either_host_ends_the_run_on_the_other() {
    for cut in [0, 1] {
        let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 1.5\n");
        let launched = run.launch("tcp", &[&CALM[..], &["--duration", "60"], &UNJUDGED].concat());
        let joined = run.join(1, "tcp", None);
        run.sites[1].bench.await_commits("controller", 100);
        run.sites[cut].cut_power();
        let (launched, joined) = (launched.wait(), joined.wait());
        if cut == 1 {
            let incident = launched.json()["incidents"][0].clone();
            let cause = incident["cause"].as_str().unwrap();
            assert!(LOST.contains(&incident["code"].as_str().unwrap()), "{incident}");
            assert!(cause.contains("flight") && cause.contains("1.5 s"), "{incident}");
            assert_eq!((launched.code, joined.signal), (Some(4), Some(SIGKILL)));
        } else {
            assert_eq!((launched.signal, joined.code), (Some(SIGKILL), Some(4)), "{joined:?}");
            assert!(joined.says("run-failed") && joined.stderr.contains("1.5 s"), "{}", joined.stderr);
        }
        run.sites[1 - cut].bench.assert_clean(&[]);
        // The next run on that site removes the files that the power cut left.
        run.sites[cut]
            .bench
            .run(&["run", "rigid-pair", "--clock", "lockstep", "--duration", "0.1", UNJUDGED[0], UNJUDGED[1]])
            .succeeded();
        run.assert_clean();
    }
}

#[test]
fn killed_roles_on_any_host_change_no_bit_in_lockstep() {
    let run = Run::new(&TWO, KEYS, "");
    let long = [&["--tick-hz", "200", "--duration", "150"][..], &UNJUDGED].concat();
    let launched = run.launch("tcp", &[&long[..], &["--clock", "lockstep"]].concat());
    let joined = run.join(1, "tcp", None);
    run.sites[1].bench.await_commits("controller", 100);
    let killed = [(1, "controller"), (1, "observer"), (0, "follower"), (0, "leader")];
    for (site, role) in killed {
        let bench = &run.sites[site].bench;
        common::send_signal(bench.await_role(role), SIGKILL);
        // Until the role is restored, the next one is not killed.
        let before = bench.commits(role);
        bench.await_commits(role, before + 100);
    }
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&summary), run_of(&run.in_process(&long)));
    let mut roles: Vec<&str> =
        summary["incidents"].as_array().unwrap().iter().map(|incident| incident["role"].as_str().unwrap()).collect();
    roles.sort_unstable();
    assert_eq!(roles, ["controller", "follower", "leader", "observer"]);
    run.assert_clean();
}

#[test]
fn a_killed_relay_ends_the_run_on_both_sides() {
    for side in [0, 1] {
        let run = Run::new(&TWO, KEYS, "[network]\nsilence_timeout_s = 1.5\n");
        let launched = run.launch("tcp", &[&CALM[..], &["--duration", "60"], &UNJUDGED].concat());
        let joined = run.join(1, "tcp", None);
        run.sites[1].bench.await_commits("controller", 100);
        common::send_signal(run.sites[side].bench.await_role("relay"), SIGKILL);
        let (launched, joined) = (launched.wait(), joined.wait());
        assert_eq!((launched.code, joined.code), (Some(4), Some(4)), "{launched:?} {joined:?}");
        let causes = launched.json()["incidents"].to_string();
        let expected = if side == 0 { "relay" } else { "flight" };
        assert!(causes.contains(expected), "{causes}");
        run.assert_clean();
    }
}

/// All sites share CLOCK_TAI, as if PTP synchronised it.
#[test]
fn clock_source_system_uses_clock_tai() {
    let run = Run::new(&TWO, KEYS, "[network]\nclock_source = \"system\"\n");
    let launched = run.launch("tcp", &[&["--tick-hz", "200", "--duration", "2"][..], &UNJUDGED].concat());
    let joined = run.join(1, "tcp", None);
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    let clock = &summary["hosts"]["hosts"][1]["clock"];
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let error_us = (clock["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(clock["source"] == "system" && error_us <= clock["error_us"].as_f64().unwrap(), "{error_us} us: {clock}");
    println!("clock error by CLOCK_TAI {error_us:.2} us");
    run.assert_clean();
}

/// Also measures the connection while the run goes on.
#[test]
fn a_host_that_the_run_does_not_wait_for_is_refused_with_a_reason() {
    let run = Run::new(&TWO, KEYS, "");
    let both = run.endless();
    let address = format!("tcp/{}:{}", run.sites[1].hub(), run.port);
    let stranger = run.sites[1].start(&["join", &address, "--host", "moon", "--insecure"]).wait();
    assert_eq!(stranger.code, Some(2), "{stranger:?}");
    assert!(stranger.says("join-refused") && stranger.stderr.contains("flight"), "{}", stranger.stderr);
    let hub = run.sites[1].start(&["join", &address, "--host", "bench", "--insecure"]).wait();
    assert!(hub.says("join-refused") && hub.stderr.contains("flight"), "{}", hub.stderr);
    let probe = run.sites[1].start(&["doctor", "--link", &address, "--insecure", "--seconds", "1", "--json"]).wait();
    let probe = probe.json();
    let truth_ns = if apart() { -APART_S * 1_000_000_000 } else { 0 };
    let error_us = (probe["offset_ns"].as_i64().unwrap() - truth_ns).abs() as f64 / 1e3;
    assert!(error_us <= probe["error_us"].as_f64().unwrap(), "error {error_us} us: {probe}");
    let second = run.sites[1].start(&["join", &address, "--insecure"]).wait();
    assert!(second.says("join-refused") && second.stderr.contains("--host"), "{}", second.stderr);
    run.end(both);
}

#[test]
fn watch_and_record_work_on_the_launching_host_only() {
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

#[test]
fn listening_needs_hosts_and_beyond_loopback_keys_or_insecure() {
    let run = Run::new(&TWO, KEYS, "");
    let refused = |arguments: &[&str], code: &str| {
        let done = run.sites[0].bench.run(arguments);
        assert_eq!(done.code, Some(2), "{arguments:?}: {done:?}");
        assert!(done.says(code), "{arguments:?}: {}", done.stderr);
    };
    let run_with = |options: &[&'static str]| [&["run", run.file()], options].concat();
    refused(&run_with(&["--host", "bench", "--listen", "tcp/0.0.0.0:1"]), "open-address");
    refused(&run_with(&["--host", "bench", "--listen", "quic/127.0.0.1:1"]), "missing-keys");
    refused(&run_with(&["--host", "moon", "--listen", "tcp/127.0.0.1:1"]), "no-such-host");
    // The parser of the command line refuses these, without a code.
    for (arguments, word) in [(run_with(&["--host", "bench"]), "--listen"), (vec!["join", "tls/192.0.2.1:1"], "<ADDR>")]
    {
        let done = run.sites[0].bench.run(&arguments);
        assert!(done.code == Some(2) && done.stderr.contains(word), "{done:?}");
    }
    refused(&["run", "rigid-pair", "--host", "bench", "--listen", "tcp/127.0.0.1:1"], "no-hosts");
    refused(&["join", "tcp/192.0.2.1:1"], "open-address");
    run.assert_clean();
}

/// Creates an authority, and a key signed by it for each name and address.
fn make_keys(directory: &Path, authority: &str, hosts: &[(&str, &str)]) {
    let openssl = |words: &[&str]| {
        let done = Command::new("openssl").args(words).current_dir(directory).output().unwrap();
        assert!(done.status.success(), "{words:?}: {}", String::from_utf8_lossy(&done.stderr));
    };
    let file = |name: &str, kind: &str| format!("{name}.{kind}");
    let new = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-noenc", "-days", "30"];
    let (ca, ca_key) = (file(authority, "pem"), file(authority, "key"));
    let subject = format!("/CN={authority}");
    openssl(&[&["req", "-x509"][..], &new, &["-keyout", &ca_key, "-out", &ca, "-subj", &subject]].concat());
    for (host, address) in hosts {
        let (cert, key) = (file(host, "pem"), file(host, "key"));
        let (subject, names) = (format!("/CN={host}"), format!("subjectAltName=IP:{address},DNS:{host}"));
        let signed =
            ["-CA", &ca, "-CAkey", &ca_key, "-keyout", &key, "-out", &cert, "-subj", &subject, "-addext", &names];
        let leaf = ["-addext", "basicConstraints=critical,CA:FALSE"];
        openssl(&[&["req", "-x509"][..], &new, &signed, &leaf].concat());
    }
}

/// Over QUIC both sides show a certificate.
#[test]
fn a_host_without_a_key_of_the_run_s_authority_cannot_join() {
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
        assert!(refused.says("cannot-connect"), "{}", refused.stderr);
    }
    let joined = start(&run.sites[1], &["join", &address], &options("ours", "flight"));
    let (done, summary) = finish(launched, joined);
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(run_of(&summary), run_of(&run.in_process(&[&SLOW[..], &UNJUDGED].concat())));
    assert_eq!(summary["hosts"]["hosts"][0]["malformed"], 0);
    run.assert_clean();
}
