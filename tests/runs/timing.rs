//! Timing as a disturbance: jitter, bursts, weakly-hard losses, missed ticks. The same bits under every clock, in every
//! replay, and whoever is killed on the way.

use crate::common::{Bench, shipped};
use serde_json::{Value, json};

/// A loop of three quarters of a second, with these faults.
fn scenario(bench: &Bench, name: &str, faults: &str) -> String {
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let file = bench.path(&format!("{name}.toml"));
    std::fs::write(&file, text + "\n" + faults).unwrap();
    file.to_str().unwrap().to_owned()
}

fn fault(kind: &str, role: &str, further: &str) -> String {
    format!("[[fault]]\nkind = \"{kind}\"\nrole = \"{role}\"\nfrom_tick = 100\nticks = 500\n{further}\n")
}

/// Every way of being late, lost or missed, on every kind of role.
fn cases() -> Vec<String> {
    let jitter = |ticks: u64, name: &str| format!("delay_ticks = 0\njitter_ticks = {ticks}\ndistribution = \"{name}\"");
    let hard = |pattern: &str| format!("weakly_hard = {{ misses = 3, window = 10, pattern = \"{pattern}\" }}");
    let channel = "gilbert_elliott = { good_to_bad = 0.02, bad_to_good = 0.2 }";
    vec![
        fault("delay", "leader", &jitter(40, "uniform")),
        fault("delay", "observer", &(jitter(6, "geometric") + "\nspread_ticks = 0.5")),
        fault("delay", "controller", &(jitter(8, "normal") + "\nspread_ticks = 2.0\nprobability = 0.5")),
        fault("drop", "leader", channel),
        fault("drop", "controller", &(hard("random") + "\nprobability = 0.5")),
        fault("drop", "follower", &hard("burst")),
        fault("drop", "observer", &hard("even")),
        fault("miss", "leader", "every = 7"),
        fault("miss", "follower", ""),
        fault("miss", "observer", &hard("burst")),
        fault("miss", "controller", channel),
        // All at once, and one role with both: what it missed is late by more, and the body may be behind when it is asked.
        fault("miss", "follower", "every = 5")
            + &fault("delay", "follower", &jitter(3, "uniform"))
            + &fault("miss", "observer", "probability = 0.1")
            + &fault("drop", "controller", channel),
    ]
}

fn run_recorded(bench: &Bench, file: &str, clock: &str, further: &[&str]) -> Value {
    let arguments = ["run", file, "--json", "--clock", clock, "--out", clock, "--overwrite", "--set=duration_s=0.75"];
    let done = bench.run(&[&arguments[..], &["--set=accept={}", "--set=record=true"], further].concat()).succeeded();
    let summary = done.json();
    assert_eq!(summary["books"]["balanced"], true, "{}", summary["books"]["problems"]);
    summary
}

#[test]
fn timing_is_the_same_in_one_thread_among_processes_and_in_every_replay() {
    for case in cases() {
        let bench = Bench::new();
        let file = scenario(&bench, "case", &case);
        let [one, many] = ["in-process", "lockstep"].map(|clock| run_recorded(&bench, &file, clock, &[]));
        assert_eq!(one["state"], many["state"], "{case}");
        assert_eq!(one["books"], many["books"], "{case}");
        let acted = one["books"]["injected_faults"].as_u64().unwrap();
        assert!((10..=1100).contains(&acted), "{case}: {acted}");
        for arguments in
            [&["replay", "in-process"][..], &["replay", "lockstep"], &["replay", "--processes", "lockstep"]]
        {
            let done = bench.run(arguments);
            assert_eq!(done.code, Some(0), "{case}: {done:?}");
            assert_eq!(done.stdout.matches("the same to the last bit").count(), 4, "{case}: {done:?}");
            assert!(!done.stdout.contains("nothing can be compared"), "{case}: {done:?}");
        }
    }
}

/// A missed tick counts as missed, as scripted and as injected; whoever lacks its sample misses too, or starves.
#[test]
fn a_role_that_misses_every_nth_tick_is_counted_so() {
    let bench = Bench::new();
    for (role, [missed, starved]) in [
        ("leader", ["leader observer controller", "follower"]),
        ("observer", ["observer controller", "follower"]),
        ("controller", ["controller", "follower"]),
        ("follower", ["follower", "controller follower"]),
    ] {
        let file = scenario(&bench, role, &fault("miss", role, "every = 10"));
        let summary = run_recorded(&bench, &file, "in-process", &[]);
        let of = |other: &str, counter: &str| summary["books"]["roles"][other][counter].as_u64().unwrap();
        for other in ["leader", "follower", "observer", "controller"] {
            let expected = |roles: &str| if roles.contains(other) { 50 } else { 0 };
            assert_eq!(of(other, "missed"), expected(missed), "{role}: {other}");
            assert_eq!(of(other, "starved"), expected(starved), "{role}: {other}");
            assert_eq!(of(other, "scripted"), if other == role { 50 } else { 0 }, "{role}: {other}");
        }
        assert_eq!(summary["books"]["injected_faults"], 50, "{role}");
    }
}

/// Nobody serves a body whose process misses ticks: it holds its last command and then goes to the safe one.
#[test]
fn a_plant_that_misses_ticks_protects_itself() {
    let bench = Bench::new();
    let fault = fault("miss", "follower", "").replace("ticks = 500", "ticks = 30");
    let file = scenario(&bench, "stalled", &fault);
    let safe = |timeout: u64| {
        let timeout = format!("--set=actuator.command_timeout_ticks={timeout}");
        let summary = run_recorded(&bench, &file, "in-process", &[&timeout]);
        (summary["score"]["statuses"]["follower/truth"].clone(), summary["state"]["hash"].clone())
    };
    // At the first tick that it executes again it has no command either: of the tick before there was no measurement.
    let (short, long) = (safe(10), safe(40));
    assert_eq!((short.0, long.0), (json!({"safe": 1}), json!({"holding": 1})));
    assert_ne!(short.1, long.1, "the body moved otherwise while it was safe");
}

/// Whoever dies in the midst of it, its successor goes on as if nothing had happened.
#[test]
fn a_kill_amid_bad_timing_costs_no_bit() {
    let all = cases();
    let case = all.last().unwrap();
    for role in ["leader", "follower", "observer", "controller"] {
        let bench = Bench::new();
        let whole = run_recorded(&bench, &scenario(&bench, "whole", case), "lockstep", &[]);
        // At a tick that it executes, and at one that it misses.
        for tick in [301, 305, 342] {
            let kill = format!("[[fault]]\nkind = \"kill\"\nrole = \"{role}\"\nfrom_tick = {tick}\n");
            let file = scenario(&bench, "killed", &(case.clone() + &kill));
            for clock in ["lockstep", "in-process"] {
                let killed = run_recorded(&bench, &file, clock, &[]);
                assert_eq!(killed["incidents"].as_array().unwrap().len(), 1, "{role} {tick} {clock}");
                assert_eq!(killed["state"]["hash"], whole["state"]["hash"], "{role} {tick} {clock}");
                let ticks = |summary: &Value| summary["books"]["roles"].clone();
                assert_eq!(ticks(&killed), ticks(&whole), "{role} {tick} {clock}");
            }
        }
    }
}

/// In real time too, as long as nothing else is missed: at 50 Hz that is nearly always so.
#[test]
fn in_real_time_bad_timing_has_the_same_bits() {
    const ATTEMPTS: usize = 20;
    for case in cases() {
        let bench = Bench::new();
        let case = case.replace("from_tick = 100\nticks = 500", "from_tick = 5\nticks = 80");
        let file = scenario(&bench, "case", &case);
        let slow = ["--set=tick_hz=50", "--set=duration_s=1.2"];
        let expected = run_recorded(&bench, &file, "lockstep", &slow);
        let missed = |summary: &Value, counter: &str| {
            let roles = summary["books"]["roles"].as_object().unwrap();
            roles.values().map(|role| role[counter].as_u64().unwrap()).sum::<u64>()
        };
        let undisturbed = |summary: &Value| {
            ["missed", "starved", "scripted"].iter().all(|of| missed(summary, of) == missed(&expected, of))
        };
        let mut runs = (0..ATTEMPTS).map(|_| run_recorded(&bench, &file, "realtime", &slow));
        let clean = runs
            .find(undisturbed)
            .unwrap_or_else(|| panic!("{case}: in none of {ATTEMPTS} runs was nothing else missed"));
        assert_eq!(clean["state"]["hash"], expected["state"]["hash"], "{case}");
        assert_eq!(clean["books"]["injected_faults"], expected["books"]["injected_faults"], "{case}");
        let done = bench.run(&["replay", "realtime"]);
        assert_eq!(done.code, Some(0), "{case}: {done:?}");
        assert_eq!(done.stdout.matches("the same to the last bit").count(), 4, "{case}: {done:?}");
    }
}
