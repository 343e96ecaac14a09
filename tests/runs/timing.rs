//! Injected timing faults (jitter, bursts, weakly-hard losses, missed ticks): the same bits under every clock, in every
//! replay and after every kill.

use crate::common::{Bench, shipped};
use serde_json::{Value, json};

/// Writes a scenario with these faults and returns its path.
fn scenario(bench: &Bench, name: &str, faults: &str) -> String {
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let file = bench.path(&format!("{name}.toml"));
    std::fs::write(&file, text + "\n" + faults).unwrap();
    file.to_str().unwrap().to_owned()
}

fn fault(kind: &str, role: &str, further: &str) -> String {
    format!("[[fault]]\nkind = \"{kind}\"\nrole = \"{role}\"\nfrom_tick = 100\nticks = 500\n{further}\n")
}

/// Returns every kind of timing fault, on every kind of role.
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
        // Several roles at once, and one with two faults: a sample of a missed tick is delayed even more.
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
fn timing_faults_are_the_same_in_process_in_lockstep_and_in_every_replay() {
    for case in cases() {
        let bench = Bench::new();
        let file = scenario(&bench, "case", &case);
        let [in_process, lockstep] = ["in-process", "lockstep"].map(|clock| run_recorded(&bench, &file, clock, &[]));
        assert_eq!(in_process["state"], lockstep["state"], "{case}");
        assert_eq!(in_process["books"], lockstep["books"], "{case}");
        let injected = in_process["books"]["injected_faults"].as_u64().unwrap();
        assert!((10..=1100).contains(&injected), "{case}: {injected}");
        for arguments in
            [&["replay", "in-process"][..], &["replay", "lockstep"], &["replay", "--processes", "lockstep"]]
        {
            let done = bench.run(&[arguments, &["--json"]].concat());
            assert_eq!((done.code, done.roles_replayed()), (Some(0), (4, 4)), "{case}: {done:?}");
        }
    }
}

/// An injected miss counts as missed, scripted and injected. The readers of the missing sample miss the tick or starve.
#[test]
fn every_injected_miss_is_counted_at_the_role_and_its_readers() {
    let bench = Bench::new();
    for (role, [missed, starved]) in [
        ("leader", ["leader observer controller", "follower"]),
        ("observer", ["observer controller", "follower"]),
        ("controller", ["controller", "follower"]),
        ("follower", ["follower", "controller follower"]),
    ] {
        let file = scenario(&bench, role, &fault("miss", role, "every = 10"));
        let summary = run_recorded(&bench, &file, "in-process", &[]);
        for counted in ["leader", "follower", "observer", "controller"] {
            let counters = &summary["books"]["roles"][counted];
            let expected = |roles: &str| if roles.contains(counted) { 50 } else { 0 };
            assert_eq!(counters["missed"], expected(missed), "{role}: {counted}");
            assert_eq!(counters["starved"], expected(starved), "{role}: {counted}");
            assert_eq!(counters["scripted"], expected(role), "{role}: {counted}");
        }
        assert_eq!(summary["books"]["injected_faults"], 50, "{role}");
    }
}

#[test]
fn a_body_without_a_process_holds_its_command_and_then_becomes_safe() {
    let bench = Bench::new();
    let fault = fault("miss", "follower", "").replace("ticks = 500", "ticks = 30");
    let file = scenario(&bench, "stalled", &fault);
    let safe = |timeout: u64| {
        let timeout = format!("--set=actuator.command_timeout_ticks={timeout}");
        let summary = run_recorded(&bench, &file, "in-process", &[&timeout]);
        (summary["score"]["statuses"]["follower/truth"].clone(), summary["state"]["hash"].clone())
    };
    // At the first executed tick there is no command: the tick before had no measurement.
    let (short, long) = (safe(10), safe(40));
    assert_eq!((short.0, long.0), (json!({"safe": 1}), json!({"holding": 1})));
    assert_ne!(short.1, long.1, "the safe command moves the body differently");
}

#[test]
fn a_kill_among_timing_faults_does_not_change_the_hash() {
    let all = cases();
    let case = all.last().unwrap();
    for role in ["leader", "follower", "observer", "controller"] {
        let bench = Bench::new();
        let whole = run_recorded(&bench, &scenario(&bench, "whole", case), "lockstep", &[]);
        // At ticks that the role executes and at one that it misses.
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

/// Compares a run in which no other tick is missed; at 50 Hz nearly every run is one.
#[test]
fn timing_faults_in_real_time_have_the_same_hash_as_in_lockstep() {
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
            ["missed", "starved", "scripted"].iter().all(|key| missed(summary, key) == missed(&expected, key))
        };
        let mut runs = (0..ATTEMPTS).map(|_| run_recorded(&bench, &file, "realtime", &slow));
        let clean =
            runs.find(undisturbed).unwrap_or_else(|| panic!("{case}: each of {ATTEMPTS} runs missed other ticks"));
        assert_eq!(clean["state"]["hash"], expected["state"]["hash"], "{case}");
        assert_eq!(clean["books"]["injected_faults"], expected["books"]["injected_faults"], "{case}");
        let done = bench.run(&["replay", "realtime", "--json"]);
        assert_eq!((done.code, done.roles_replayed().0), (Some(0), 4), "{case}: {done:?}");
    }
}
