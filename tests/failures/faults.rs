//! Scripted faults: no single fault moves a follower outside the declared bound, every fault is counted, the counters
//! balance, the loop converges again, and all clocks agree.

use crate::common::{Bench, shipped};
use corotate::launch::{Launch, Summary, run};
use corotate::role::SUSPECT_SAMPLES;
use corotate::scenario::Scenario;
use serde_json::Value;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::SystemTime;

/// The declared bound of `faults.toml`, rad/s.
const BOUND_RAD_S: f64 = 0.1;
/// Largest effect of a fault that no counter shows, rad/s: V at the watchdog's bound.
const HARMLESS_RAD_S: f64 = 0.01;
/// The final synchronisation error of a settled loop, rad/s.
const SETTLED_RAD_S: f64 = 1e-6;
/// First ticks of the faults in the matrix: two phases of the leader's motion.
const FROM_TICKS: [u64; 2] = [200, 1777];
/// A loop that is settled from the first tick on, so that every deviation comes from a fault.
const SETTLED: [&str; 6] = [
    "clock=in-process",
    "duration_s=7",
    "accept={}",
    "watchdog.from_s=0.1",
    "follower.0.initial_rate_rad_s=[0.6, -0.4, 0.8]",
    "observer.initial_guess_rad_s=0.8",
];

/// Returns `faults.toml` with these faults instead.
fn text(faults: &str) -> String {
    let text = std::fs::read_to_string(shipped("faults")).unwrap();
    text.split("\n# Every fault").next().unwrap().to_owned() + "\n" + faults
}

/// The result of one disturbed run.
struct Disturbed {
    peak: f64,
    last: f64,
    summary: Value,
}

impl Disturbed {
    /// Runs a scenario in this thread.
    fn run(scenario: &Scenario) -> Self {
        let outcome = run(scenario, &mut Launch::new(&AtomicUsize::new(0), &mut |_| {})).unwrap();
        let summary = serde_json::to_value(Summary::new(scenario, &outcome, SystemTime::UNIX_EPOCH)).unwrap();
        let metric = &summary["score"]["metrics"][0];
        let number = |key: &str| metric[key].as_f64().unwrap_or(f64::INFINITY);
        Self { peak: number("peak"), last: number("last"), summary }
    }

    fn with_fault(fault: &str, overrides: &[&str]) -> Self {
        let overrides: Vec<String> = overrides.iter().map(|set| (*set).to_owned()).collect();
        Self::run(
            &Scenario::parse(&text(fault), "matrix", &overrides).unwrap_or_else(|error| panic!("{fault}: {error}")),
        )
    }

    fn count(&self, counter: &str) -> u64 {
        self.summary["books"][counter].as_u64().unwrap()
    }

    /// Returns true if any counter except that of injected faults shows a problem.
    fn is_counted(&self) -> bool {
        let links = self.summary["books"]["links"].as_array().unwrap();
        let problems = |link: &Value| link["stale"].as_u64().unwrap() + link["void"][1].as_u64().unwrap();
        let breaches = self.summary["watchdog"]["watched"].as_array().unwrap().iter();
        self.count("rejected_samples")
            + self.count("missed_ticks")
            + links.iter().map(problems).sum::<u64>()
            + breaches.map(|watched| watched["breaches"].as_u64().unwrap()).sum::<u64>()
            > 0
    }
}

fn fault(kind: &str, role: &str, from_tick: u64, ticks: u64, further: &str) -> String {
    format!("[[fault]]\nkind = \"{kind}\"\nrole = \"{role}\"\nfrom_tick = {from_tick}\nticks = {ticks}\n{further}\n")
}

/// Returns the fields that a role sends, with their number of components.
fn fields(role: &str) -> &'static [(&'static str, usize)] {
    match role {
        "observer" => &[
            ("omega_rad_s", 3),
            ("innovation_rad_s", 1),
            ("coefficients", 3),
            ("closure", 1),
            ("inertia_ratios", 2),
            ("excitation", 1),
            ("valid", 1),
            ("status", 1),
            ("tick", 1),
            ("generation", 1),
        ],
        "controller" => &[
            ("acceleration_rad_s2", 3),
            ("lyapunov_rad2_s2", 1),
            ("lyapunov_rate_bound_rad2_s3", 1),
            ("tick", 1),
            ("generation", 1),
        ],
        _ => &[("omega_rad_s", 3), ("applied_rad_s2", 3), ("valid", 1), ("status", 1), ("tick", 1), ("generation", 1)],
    }
}

const ROLES: [&str; 4] = ["leader", "follower", "observer", "controller"];

/// Returns true if every fault of the matrix is injected, instead of a sample.
fn is_campaign() -> bool {
    std::env::var("COROTATE_FAULTS").is_ok_and(|faults| faults == "all")
}

/// Returns a fault for every bit of every sent field. Outside of a campaign only every eighth of the 52 lowest bits, the fraction of a
/// number, is flipped, and the 16 lowest of a field that is not a number with a unit.
fn flips() -> Vec<String> {
    const FRACTION_BITS: u32 = f64::MANTISSA_DIGITS - 1;
    let mut faults = Vec::new();
    for role in ROLES {
        for (field, count) in fields(role) {
            let low_bits = if ["valid", "status", "tick", "generation"].contains(field) { 16 } else { 0 };
            let is_flipped =
                |bit: &u32| is_campaign() || *bit < low_bits || *bit >= FRACTION_BITS || bit.is_multiple_of(8);
            for (component, bit) in
                (1..=*count).flat_map(|component| (0..64).filter(is_flipped).map(move |bit| (component, bit)))
            {
                let what = format!("field = \"{field}\"\ncomponent = {component}\nbit = {bit}");
                faults.push(fault("bit-flip", role, FROM_TICKS[0], 1, &what));
            }
        }
    }
    faults
}

/// Returns faults of every other kind, on every applicable role, for one tick to one second.
fn other_faults() -> Vec<String> {
    let mut faults = Vec::new();
    let lengths: &[u64] = if is_campaign() { &[1, 5, 20, 200, 1000] } else { &[1, 20, 1000] };
    for (role, from) in ROLES.into_iter().flat_map(|role| FROM_TICKS.map(|from| (role, from))) {
        for &ticks in lengths {
            let mut add = |kind: &str, further: &str| faults.push(fault(kind, role, from, ticks, further));
            ["drop", "duplicate", "freeze", "not-a-number", "infinite"].into_iter().for_each(|kind| add(kind, ""));
            ["delay_ticks = 1", "delay_ticks = 3", "delay_ticks = 50"].into_iter().for_each(|by| add("delay", by));
            for component in 1..=3 {
                add("not-a-number", &format!("component = {component}"));
                add("freeze", &format!("component = {component}"));
                add("out-of-range", &format!("value = 9.0\ncomponent = {component}"));
                add("out-of-range", &format!("value = -1e30\ncomponent = {component}"));
                if role != "controller" {
                    add("lost-axis", &format!("component = {component}"));
                }
            }
            if ticks <= 200 {
                let deviations = ["1e-3", "0.1", "1.0"];
                deviations.into_iter().for_each(|by| add("noise-burst", &format!("deviation = {by}")));
            }
        }
        faults.push(fault("stall", role, from, 3, "stall_ms = 0.1"));
    }
    faults
}

/// Runs every fault in a run of its own, on all cores, and passes each result to `judge`.
fn every(faults: &[String], overrides: &[&str], judge: impl Fn(&str, &Disturbed) + Sync) {
    let (next, worst) = (AtomicUsize::new(0), Mutex::new(BTreeMap::<String, (u64, f64)>::new()));
    let work = || {
        while let Some(fault) = faults.get(next.fetch_add(1, Ordering::Relaxed)) {
            let done = Disturbed::with_fault(fault, overrides);
            judge(fault, &done);
            let kind = fault.split('"').nth(1).unwrap().to_owned();
            let mut worst = worst.lock().unwrap();
            let entry = worst.entry(kind).or_default();
            *entry = (entry.0 + 1, entry.1.max(done.peak));
        }
    };
    std::thread::scope(|scope| {
        (0..std::thread::available_parallelism().map_or(1, usize::from)).for_each(|_| {
            scope.spawn(work);
        });
    });
    let worst = worst.into_inner().unwrap();
    worst.iter().for_each(|(kind, (count, peak))| println!("{kind}: {count} faults, worst excursion {peak:.1e}"));
}

fn assert_within_the_bound(fault: &str, done: &Disturbed) {
    assert!(done.peak <= BOUND_RAD_S, "{fault}: {:e}", done.peak);
    assert!(done.last < SETTLED_RAD_S, "{fault}: {:e} at the end", done.last);
    assert_eq!(done.summary["books"]["balanced"], true, "{fault}: {}", done.summary["books"]["problems"]);
    assert!(done.count("injected_faults") >= 1, "{fault} did not act");
    assert!(done.is_counted() || done.peak < HARMLESS_RAD_S, "{fault}: {:e}, and no counter shows it", done.peak);
}

#[test]
fn no_bit_flip_moves_the_follower_outside_the_declared_bound() {
    let faults = flips();
    assert!(faults.len() > if is_campaign() { 2500 } else { 900 }, "{}", faults.len());
    every(&faults, &SETTLED, assert_within_the_bound);
}

#[test]
fn no_other_fault_moves_the_follower_outside_the_declared_bound() {
    every(&other_faults(), &SETTLED, assert_within_the_bound);
}

/// Repeated random bit flips in random components, with several seeds.
#[test]
fn random_bit_flips_do_not_move_the_follower_outside_the_declared_bound() {
    for seed in 1..=8 {
        let seed = format!("seed={seed}");
        let faults = ROLES.map(|role| fault("bit-flip", role, FROM_TICKS[0], 50, "probability = 0.3"));
        every(&faults, &[&SETTLED[..], &[&seed]].concat(), assert_within_the_bound);
    }
}

/// The bound can be broken: by a wrong command within the actuators' limits for one second.
#[test]
fn a_plausible_wrong_command_breaks_the_bound_and_latches_the_watchdog() {
    let push = fault("out-of-range", "controller", FROM_TICKS[0], 1000, "value = 7.9\ncomponent = 1");
    let done = Disturbed::with_fault(&push, &SETTLED);
    assert!(done.peak > 10.0 * BOUND_RAD_S, "{:e}", done.peak);
    let safe = [&SETTLED[..], &["watchdog.on_breach=safe", "watchdog.latch_after_ticks=3"]].concat();
    let ended = Disturbed::with_fault(&push, &safe);
    let latched = ended.summary["watchdog"]["latched_at_tick"].as_u64().unwrap();
    assert!(latched > FROM_TICKS[0] && latched < FROM_TICKS[0] + 50, "{latched}");
    assert!(ended.peak < 0.5 * done.peak, "{:e} {:e}", ended.peak, done.peak);
    assert_eq!(ended.summary["books"]["balanced"], true, "{:#}", ended.summary["books"]);
    let safe_ticks = ended.summary["books"]["roles"]["follower"]["safe"].as_u64().unwrap();
    assert_eq!(safe_ticks, 7000 - latched - 20, "permanently, 20 ticks after the latch");
}

#[test]
fn the_watchdog_counts_violations_of_the_physics() {
    let quiet = Disturbed::with_fault("", &SETTLED);
    for watched in quiet.summary["watchdog"]["watched"].as_array().unwrap() {
        assert_eq!(watched["breaches"], 0, "{watched}");
        assert!(watched["judged"].as_u64().unwrap() > 6000, "{watched}");
    }
    // A wrong estimate that no guard can detect.
    let wrong = fault("noise-burst", "observer", 300, 100, "deviation = 0.01");
    let tight = ["watchdog.energy_drift_max=1e-3", "watchdog.momentum_drift_max=1e-3"];
    let done = Disturbed::with_fault(&wrong, &[&SETTLED[..], &tight].concat());
    for quantity in ["energy_drift", "momentum_drift"] {
        let watched = done.summary["watchdog"]["watched"].as_array().unwrap();
        let entry = watched.iter().find(|entry| entry["quantity"] == quantity).unwrap();
        assert!(entry["breaches"].as_u64().unwrap() > 50, "{entry}");
        assert_eq!(entry["first_tick"].as_u64().unwrap() / 10, 30, "{entry}");
    }
}

/// The orbit rigs have the same guards: impossible samples move no follower.
#[test]
fn no_impossible_sample_moves_a_follower_in_orbit() {
    let text = std::fs::read_to_string(shipped("orbit-rendezvous")).unwrap();
    let declared =
        ["accept.peak_from_s=11.0", "accept.radius_error_du_peak=1e-3", "accept.velocity_error_du_s_peak=1e-3"];
    let overrides = [&["clock=in-process", "limits.repeats=2"], &declared[..]].concat();
    let overrides: Vec<String> = overrides.into_iter().map(str::to_owned).collect();
    let (mut count, mut worst) = (0, 0.0_f64);
    for role in ROLES {
        for (kind, further) in [
            ("drop", ""),
            ("duplicate", ""),
            ("delay", "delay_ticks = 3"),
            ("freeze", ""),
            ("not-a-number", ""),
            ("infinite", ""),
            ("out-of-range", "value = 1e3"),
            ("out-of-range", "value = -1.0"),
            ("lost-axis", "component = 1"),
            ("bit-flip", "bit = 62"),
            ("bit-flip", "field = \"tick\"\nbit = 40"),
        ] {
            if (kind, role) == ("lost-axis", "controller") {
                continue;
            }
            let fault = fault(kind, role, 11_000, 10, further);
            let text = format!("{text}\n{fault}");
            let done = Disturbed::run(&Scenario::parse(&text, "orbit", &overrides).unwrap());
            assert_eq!(done.summary["accepted"], true, "{fault}: {}", done.summary["criteria"]);
            assert_eq!(done.summary["books"]["balanced"], true, "{fault}: {}", done.summary["books"]["problems"]);
            assert_eq!(done.count("injected_faults"), 10, "{fault}");
            (count, worst) = (count + 1, worst.max(done.peak));
        }
    }
    println!("{count} faults in orbit, worst excursion {worst:.1e} du of 1e-3 declared");
}

/// One fault of each kind, in lockstep processes and in one thread: same bits, counters and verdict.
#[test]
fn every_fault_is_the_same_in_lockstep_and_in_process() {
    let cases = [
        fault("drop", "leader", 100, 7, "probability = 0.5"),
        fault("drop", "leader", 100, 300, ""),
        fault("drop", "controller", 100, 30, ""),
        fault("duplicate", "follower", 100, 200, ""),
        fault("delay", "observer", 100, 5, "delay_ticks = 3"),
        fault("delay", "leader", 100, 90, "delay_ticks = 40"),
        fault("freeze", "follower", 100, 40, ""),
        fault("not-a-number", "leader", 100, 40, ""),
        fault("infinite", "observer", 100, 200, ""),
        fault("out-of-range", "controller", 100, 10, "value = 1e3"),
        fault("bit-flip", "leader", 100, 50, ""),
        fault("bit-flip", "observer", 100, 2, "field = \"tick\"\nbit = 3"),
        fault("bit-flip", "controller", 100, 2, "field = \"generation\"\nbit = 1"),
        fault("lost-axis", "follower", 100, 5, "component = 2"),
        fault("noise-burst", "leader", 100, 50, "deviation = 0.1"),
        fault("stall", "observer", 100, 3, "stall_ms = 2.0"),
    ];
    let bench = Bench::new();
    for case in cases {
        let file = bench.path("case.toml");
        std::fs::write(&file, text(&case)).unwrap();
        let summary = |clock: &str| -> Value {
            let arguments = ["run", file.to_str().unwrap(), "--json", "--clock", clock, "--duration", "0.6"];
            let sets = ["--set", "accept={}", "--set", "watchdog.from_s=0"];
            let done = bench.run(&[&arguments[..], &sets].concat());
            assert_eq!(done.code, Some(0), "{case}: {done:?}");
            done.json()
        };
        let (in_process, lockstep) = (summary("in-process"), summary("lockstep"));
        assert_eq!(in_process["state"], lockstep["state"], "{case}");
        assert_eq!(in_process["books"], lockstep["books"], "{case}");
        assert_eq!(in_process["watchdog"], lockstep["watchdog"], "{case}");
        assert_eq!(in_process["books"]["balanced"], true, "{case}: {}", in_process["books"]["problems"]);
        assert!(in_process["books"]["injected_faults"].as_u64().unwrap() > 0, "{case}");
    }
}

/// In real time samples are lost, duplicated and delayed; up to the first disturbed tick the bits are the same.
#[test]
fn real_time_has_the_same_faults_and_balanced_counters() {
    let bench = Bench::new();
    for (case, disturbed_at) in [
        (fault("drop", "leader", 300, 5, ""), Some(300)),
        (fault("duplicate", "leader", 300, 20, ""), None),
        (fault("delay", "observer", 300, 4, "delay_ticks = 2"), Some(300)),
        (fault("not-a-number", "leader", 300, 20, ""), None),
        (fault("stall", "follower", 300, 1, "stall_ms = 20.0"), Some(300)),
    ] {
        let file = bench.path("case.toml");
        std::fs::write(&file, text(&case)).unwrap();
        let arguments = ["run", file.to_str().unwrap(), "--json", "--duration", "1", "--tick-hz", "500"];
        let sets = ["--set", "accept={}", "--set", "watchdog.from_s=0", "--clock", "realtime"];
        let done = bench.run(&[&arguments[..], &sets].concat());
        assert_eq!(done.code, Some(0), "{case}: {done:?}");
        let summary = done.json();
        assert_eq!(summary["books"]["balanced"], true, "{case}: {}", summary["books"]["problems"]);
        let injected = summary["books"]["injected_faults"].as_u64().unwrap();
        let missed = summary["books"]["missed_ticks"].as_u64().unwrap();
        // On a loaded machine the tick of the fault itself may be missed.
        assert!(injected > 0 || missed > 0, "{case}");
        let first = summary["state"]["first_disturbed_tick"].as_u64();
        match disturbed_at {
            Some(tick) => assert!(first.is_some_and(|first| first <= tick), "{case}: {first:?}"),
            // The fault itself disturbs no tick; if one is disturbed, a role has counted a missed tick or a missing
            // input.
            None => {
                let roles = summary["books"]["roles"].as_object().unwrap();
                let lacked = |role: &Value| role["missed"].as_u64().unwrap() + role["starved"].as_u64().unwrap();
                let lacked: u64 = roles.values().map(lacked).sum();
                assert_eq!(first.is_some(), lacked > 0, "{case}: {first:?}, {roles:?}");
            }
        }
        let overrides = ["clock=in-process", "duration_s=1", "tick_hz=500", "accept={}", "watchdog.from_s=0"];
        let clean = summary["state"]["clean_ticks"].as_u64().unwrap();
        let expected = hash_after(&case, &overrides, clean);
        assert_eq!(summary["state"]["clean_hash"].as_str().unwrap(), expected, "{case}: {clean} ticks");
    }
}

/// Returns the hash over the first ticks of a run in one thread, from `hashes.txt`.
fn hash_after(case: &str, overrides: &[&str], ticks: u64) -> String {
    let bench = Bench::new();
    let file = bench.path("case.toml");
    std::fs::write(&file, text(case)).unwrap();
    let sets: Vec<&str> = overrides.iter().flat_map(|set| ["--set", set]).collect();
    let out = bench.path("out");

    bench.run(&[&["run", file.to_str().unwrap(), "--out", out.to_str().unwrap()], &sets[..]].concat()).succeeded();
    let run = std::fs::read_dir(&out).unwrap().next().unwrap().unwrap().path();
    let directory = if run.is_dir() { run } else { out };
    let hashes = std::fs::read_to_string(directory.join("hashes.txt")).unwrap();
    let line = hashes.lines().find(|line| line.split(' ').next() == Some(&ticks.to_string()));
    line.map_or("0".repeat(16), |line| line.split(' ').nth(1).unwrap().to_owned())
}

#[test]
fn an_invalid_fault_is_refused_with_its_place() {
    let bench = Bench::new();
    let good = "kind = \"drop\"\nrole = \"leader\"\nfrom_tick = 10";
    for (change, code) in [
        (("\"drop\"", "\"dorp\""), "unknown-choice"),
        (("\"leader\"", "\"leadr\""), "unknown-role"),
        (("= 10", "= -1"), "wrong-type"),
        (("= 10", "= 10\nticks = 0"), "out-of-range"),
        (("= 10", "= 10\nprobability = 1.5"), "out-of-range"),
        (("= 10", "= 10\nvalue = 1.0"), "unused-key"),
        (("= 10", "= 10\nfield = \"omega_rad_s\""), "unused-key"),
        (("= 10", "= 10\nbody = \"follower\""), "unused-key"),
        (("drop\"\nrole = \"leader", "drop\"\nrole = \"controller\"\nbody = \"leader"), "unknown-body"),
        (("= 10", "= 10\nevery = 1\nticks = 9"), "out-of-range"),
        (("= 10", "= 10\nevery = 5"), "out-of-range"),
        (("= 10", "= 10\nticks = 9\nevery = 5\nprobability = 0.5"), "conflicting-keys"),
        (("= 10", "= 10\njitter_ticks = 2"), "unused-key"),
        (("\"drop\"", "\"delay\"\ndelay_ticks = 3\njitter_ticks = 998"), "out-of-range"),
        (("\"drop\"", "\"delay\"\ndelay_ticks = 3\ndistribution = \"normal\""), "unused-key"),
        (("\"drop\"", "\"delay\"\ndelay_ticks = 3\njitter_ticks = 4\ndistribution = \"normal\""), "missing-key"),
        (("\"drop\"", "\"delay\"\ndelay_ticks = 3\njitter_ticks = 4\nspread_ticks = 1.0"), "unused-key"),
        (("\"drop\"", "\"miss\"\nbody = \"follower\""), "unused-key"),
        (("= 10", "= 10\nticks = 99\nweakly_hard = { misses = 5, window = 5, pattern = \"burst\" }"), "out-of-range"),
        (("= 10", "= 10\nticks = 99\nweakly_hard = { misses = 5, window = 65, pattern = \"burst\" }"), "out-of-range"),
        (("= 10", "= 10\nticks = 99\nweakly_hard = { misses = 5, window = 9, pattern = \"random\" }"), "missing-key"),
        (("= 10", "= 10\nticks = 99\ngilbert_elliott = { good_to_bad = 0.0, bad_to_good = 0.1 }"), "out-of-range"),
        (
            ("= 10", "= 10\nticks = 99\nevery = 3\ngilbert_elliott = { good_to_bad = 0.1, bad_to_good = 0.1 }"),
            "conflicting-keys",
        ),
        (("\"drop\"", "\"delay\""), "missing-key"),
        (("\"drop\"", "\"delay\"\ndelay_ticks = 0"), "out-of-range"),
        (("\"drop\"", "\"bit-flip\"\nbit = 64"), "out-of-range"),
        (("\"drop\"", "\"bit-flip\"\ncomponent = 4"), "no-such-component"),
        (("\"drop\"", "\"bit-flip\"\nfield = \"omga\""), "unknown-field"),
        (("\"drop\"", "\"not-a-number\"\nfield = \"valid\""), "wrong-field"),
        (("\"drop\"", "\"freeze\"\nfield = \"tick\""), "wrong-field"),
        (("\"drop\"", "\"lost-axis\"\ncomponent = 4"), "no-such-component"),
        (("\"drop\"\nrole = \"leader\"", "\"lost-axis\"\ncomponent = 1\nrole = \"controller\""), "wrong-signal"),
        (("\"drop\"", "\"noise-burst\"\ndeviation = -1.0"), "not-positive"),
        (("\"drop\"", "\"stall\"\nstall_ms = 0.0"), "out-of-range"),
    ] {
        let file = bench.path("case.toml");
        let fault = good.replace(change.0, change.1);
        assert_ne!(fault, good, "{change:?}");
        std::fs::write(&file, text(&format!("[[fault]]\n{fault}\n"))).unwrap();
        let done = bench.run(&["check", file.to_str().unwrap(), "--set", "clock=in-process"]);
        assert!(done.code == Some(2) && done.says(code), "{fault}: {done:?}");
        assert!(done.stderr.contains("fault[0]"), "{fault}: {done:?}");
    }
}

#[test]
fn invalid_limits_and_watchdogs_are_refused() {
    let bench = Bench::new();
    for (scenario, set, code) in [
        ("faults", "limits.rate_rad_s=0.5", "limit-too-low"),
        ("faults", "limits.acceleration_rad_s2=0.0", "not-positive"),
        ("faults", "limits.speed_du_s=1.0", "unknown-key"),
        ("orbit-hold", "limits.speed_du_s=0.5", "limit-too-low"),
        ("faults", "watchdog.from_s=-1.0", "negative"),
        ("faults", "watchdog.energy_drift_max=0.0", "not-positive"),
        ("faults", "watchdog.latch_after_ticks=3", "unused-key"),
        ("faults", "watchdog.on_breach=panic", "unknown-choice"),
        ("rigid-pair", "watchdog.on_breach=safe", "no-effect"),
        ("orbit-hold", "watchdog.energy_drift_max=0.1", "unused-key"),
        ("orbit-rendezvous", "watchdog.lyapunov_rad2_s2_max=0.1", "unknown-quantity"),
        ("noisy-pair", "watchdog.innovation_rad_s_max=0.1", "unused-key"),
        ("inertia", "watchdog.energy_drift_max=0.1", "unused-key"),
        ("rigid-pair", "accept.peak_from_s=1.0", "unused-key"),
        ("faults", "accept.sync_error_rad_s_peek=1.0", "unknown-criterion"),
    ] {
        let done = bench.run(&["check", shipped(scenario).to_str().unwrap(), "--set", set]);
        assert!(done.code == Some(2) && done.says(code), "{set}: {done:?}");
    }
}

/// A scripted kill has the same effect under both clocks without time: same counters, same bits.
#[test]
fn a_killed_role_gives_the_same_bits_in_one_thread_and_as_processes() {
    for role in ["leader", "follower", "observer", "controller"] {
        let bench = Bench::new();
        let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
        let fault = format!("\n[[fault]]\nkind = \"kill\"\nrole = \"{role}\"\nfrom_tick = 2345\n");
        std::fs::write(bench.path("kill.toml"), text + &fault).unwrap();
        let summaries = ["in-process", "lockstep"].map(|clock| {
            let done = bench.run(&["run", "kill.toml", "--clock", clock, "--json", "--out", clock]);
            assert_eq!(done.code, Some(0), "{role} {clock}: {done:?}");
            serde_json::from_str::<serde_json::Value>(&done.stdout).unwrap()
        });
        let [first, second] = &summaries;
        assert_eq!(first["state"]["hash"], second["state"]["hash"], "{role}");
        assert_eq!(first["books"]["roles"], second["books"]["roles"], "{role}");
        for summary in &summaries {
            let incident = &summary["incidents"][0];
            assert_eq!((incident["role"].as_str(), incident["tick"].as_u64()), (Some(role), Some(2345)), "{incident}");
            assert_eq!(summary["books"]["balanced"], true, "{role}");
        }
        assert_eq!(first["incidents"][0]["recovery_s"], second["incidents"][0]["recovery_s"], "{role}");
        bench.assert_clean(&[]);
    }
}

/// The safe command acts at exactly the `command_timeout_ticks`th tick without a command.
#[test]
fn a_plant_is_safe_after_exactly_command_timeout_ticks() {
    for timeout in [1, 5, 20] {
        let bench = Bench::new();
        let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
        let fault = "\n[[fault]]\nkind = \"drop\"\nrole = \"controller\"\nfrom_tick = 5000\nticks = 50\n";
        std::fs::write(bench.path("silence.toml"), text + fault).unwrap();
        let timeout_key = format!("actuator.command_timeout_ticks={timeout}");
        for clock in ["in-process", "lockstep"] {
            let done =
                bench.run(&["run", "silence.toml", "--json", "--clock", clock, "--set", &timeout_key]).succeeded();
            let summary = done.json();
            let follower = &summary["books"]["roles"]["follower"];
            let counts = (follower["starved"].as_u64(), follower["safe"].as_u64());
            assert_eq!(counts, (Some(50), Some(50 - timeout + 1)), "{clock}, {timeout} ticks: {follower}");
        }
    }
}

/// A tick from the future is ignored by the scorer too: one flipped bit must not end the scoring of a run.
#[test]
fn a_tick_from_the_future_does_not_stop_the_scorer() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let fault = |role: &str, tick: u64| {
        format!("\n[[fault]]\nkind = \"bit-flip\"\nrole = \"{role}\"\nfield = \"tick\"\nbit = 40\nfrom_tick = {tick}\n")
    };
    let faults = fault("observer", 300) + &fault("controller", 350);
    std::fs::write(bench.path("future.toml"), text + &faults).unwrap();
    let run = ["run", "future.toml", "--json", "--out=out", "--duration=2", "--set=accept={}", "--clock=realtime"];
    let done = bench.run(&run).succeeded();
    let summary = done.json();
    let missed = summary["books"]["missed_ticks"].as_u64().unwrap();
    let unscored = summary["score"]["unscored_ticks"].as_u64().unwrap();
    assert!((1..=missed + 2).contains(&unscored), "{unscored} unscored, {missed} missed: {:#}", summary["books"]);
    bench.assert_clean(&[]);
}

/// Without faults every sample is right. A guard suspects samples only for a bounded time, also those of a follower
/// that a wrong first guess has driven beyond its rate limit.
#[test]
fn a_guard_accepts_right_samples_again_after_a_bounded_time() {
    let smallsat = ["leader.inertia_kg_m2=[0.082, 0.091, 0.034]", "leader.initial_rate_rad_s=[0.012, -0.01, 0.012]"];
    let at_rest = ["observer.initial_guess_rad_s=0.2", "follower.0.initial_rate_rad_s=[0.0, 0.0, 0.0]"];
    let fleet = ["follower.0.count=5", "follower.0.initial_rate_spread_rad_s=[0.1, 0.1, 0.1]"];
    let (wrong, narrow) = (["observer.initial_guess_rad_s=15.0"], ["limits.rate_rad_s=1.6"]);
    for (overrides, doubts) in [
        (wrong.to_vec(), false),
        ([smallsat, at_rest].concat(), false),
        ([wrong, narrow].concat(), true),
        ([&wrong[..], &narrow, &fleet].concat(), true),
    ] {
        let overrides = ["clock=in-process"].into_iter().chain(overrides).map(str::to_owned).collect::<Vec<_>>();
        let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
        let run = Disturbed::run(&Scenario::parse(&text, "trap", &overrides).unwrap());
        assert!(run.last < SETTLED_RAD_S, "{overrides:?}: {}", run.last);
        // Only the controller's guards suspect samples; the follower leaves its range once and returns.
        assert_eq!(run.count("rejected_samples"), if doubts { SUSPECT_SAMPLES } else { 0 }, "{overrides:?}");
    }
}
