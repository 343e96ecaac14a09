//! Roles that share a process (`launch.processes`): the same state and counters as in separate processes, joint restarts, and no
//! external roles among them.

use crate::common::{ANY_TICKS, Bench, Running, await_some, send_signal, shipped};
use libc::{SIGKILL, SIGTERM};

const BOTH: [&str; 2] = ["--set", "launch.processes=[['observer','controller']]"];
const ALL: [&str; 2] = ["--set", "launch.processes=[['leader','follower','observer','controller']]"];
const CROSSED: [&str; 2] = ["--set", "launch.processes=[['leader','controller'],['follower','observer']]"];
const HALVES: [&str; 2] = ["--set", "launch.processes=[['leader','follower'],['observer','controller']]"];

/// Reads the state hash after every tick.
fn checkpoints(bench: &Bench, directory: &str) -> Vec<String> {
    let text = std::fs::read_to_string(bench.path(directory).join("hashes.txt")).unwrap();
    text.lines().skip(1).map(str::to_owned).collect()
}

/// With one follower, two, a fleet, a spacecraft that is leader and driven body, and every kind of fault: roles in pairs across the
/// chain, and all in a single process.
#[test]
fn state_and_counters_equal_those_of_separate_processes_and_of_one_thread() {
    for scenario in ["rigid-pair", "rigid-trio", "rigid-fleet", "orbit-hold", "faults"] {
        let bench = Bench::new();
        let length: &[&str] = if scenario == "faults" { &[] } else { &["--duration", "1", "--set", "accept={}"] };
        let run = |clock: &str, more: &[&str]| bench.summary(scenario, &[length, &["--clock", clock], more].concat());
        let separate = run("lockstep", &[]);
        let roles: Vec<String> =
            separate["books"]["roles"].as_object().unwrap().keys().map(|name| format!("'{name}'")).collect();
        let crossed: Vec<String> = roles.iter().step_by(2).cloned().collect();
        let processes = |names: &[String]| format!("launch.processes=[[{}]]", names.join(","));
        let (all, crossed) = (processes(&roles), processes(&crossed));
        for shared in [BOTH[1], &all, &crossed] {
            let shared = ["--set", shared];
            let (in_thread, together) = (run("in-process", &shared), run("lockstep", &shared));
            for reference in [&in_thread, &separate] {
                assert_eq!(together["state"], reference["state"], "{scenario} {shared:?}");
                assert_eq!(together["books"]["roles"], reference["books"]["roles"], "{scenario} {shared:?}");
                assert_eq!(together["score"], reference["score"], "{scenario} {shared:?}");
                assert!(
                    reference["hosted"].is_null(),
                    "{scenario}: roles in one thread and in separate processes are not hosted"
                );
            }
            assert_eq!(together["books"]["links"], separate["books"]["links"], "{scenario} {shared:?}");
            assert_eq!(together["books"]["balanced"], true, "{scenario} {shared:?}");
            assert!(together["hosted"].as_object().is_some_and(|hosted| !hosted.is_empty()), "{scenario} {shared:?}");
        }
        bench.assert_clean(&[]);
    }
}

#[test]
fn in_real_time_the_state_agrees_until_the_first_disturbance_and_all_latencies_are_measured() {
    let bench = Bench::new();
    let common = ["--duration", "2", "--set", "accept={}", "--out"];
    let run = |clock: &str, out: &str, processes: &[&str; 2]| {
        bench.summary("rigid-pair", &[&common[..], &[out, "--clock", clock], processes].concat())
    };
    let reference = run("in-process", "in-process", &BOTH);
    let expected = checkpoints(&bench, "in-process");
    for (out, processes, host_of_observer) in [
        ("both", BOTH, "controller"),
        ("all", ALL, "controller"),
        ("crossed", CROSSED, "observer"),
        ("halves", HALVES, "controller"),
    ] {
        let live = run("realtime", out, &processes);
        assert_eq!(live["books"]["balanced"], true, "{out}: {:#}", live["books"]);
        let clean = live["state"]["clean_ticks"].as_u64().unwrap() as usize;
        println!("{out}: {clean} of 2001 ticks undisturbed");
        let seen = checkpoints(&bench, out);
        assert_eq!((expected.len(), &expected[..clean]), (2001, &seen[..clean]), "{out}");
        if live["state"]["first_disturbed_tick"].is_null() {
            assert_eq!(live["state"]["hash"], reference["state"]["hash"], "{out}");
        }
        let stages = live["latencies"].as_array().unwrap();
        for (role, measured) in [
            ("leader", &["baseline", "lateness", "step"][..]),
            ("follower", &["lateness", "age", "step"]),
            ("observer", &["hop", "step", "age"]),
            ("controller", &["hop", "step", "age"]),
        ] {
            let ticks = &live["books"]["roles"][role];
            let [executed, elapsed] = ["executed", "elapsed"].map(|key| ticks[key].as_u64().unwrap());
            for stage in measured {
                let found = stages.iter().find(|found| found["role"] == role && found["stage"] == *stage);
                let count = found.map_or(0, |found| found["count"].as_u64().unwrap());
                match (role, *stage) {
                    // Every wake is counted, and every tick of the observer.
                    ("leader", _) => assert!((1..=2001).contains(&count), "{out} {role} {stage}: {count}"),
                    ("observer", _) => assert_eq!(count, elapsed, "{out} {role} {stage}"),
                    _ => assert!(
                        (executed.min(1)..=2001).contains(&count),
                        "{out} {role} {stage}: {count} of {executed}"
                    ),
                }
            }
        }
        let has_grant = |role: &str| live["privileges"].as_array().unwrap().iter().any(|grant| grant["role"] == role);
        assert!(has_grant(host_of_observer), "{out}: {}", live["privileges"]);
        let hosted: Vec<&String> = live["hosted"].as_object().unwrap().keys().collect();
        assert!(
            hosted.iter().all(|role| !has_grant(role)),
            "{out}: privileges are requested once per process: {}",
            live["privileges"]
        );
    }
    bench.assert_clean(&[]);
}

/// Starts a run and kills the process of observer and controller during the ticks.
fn start_and_kill(bench: &Bench, arguments: &[&str]) -> Running {
    let file = shipped("rigid-pair");
    let common = ["run", file.to_str().unwrap(), "--json", "--out", "out"];
    let running = bench.start(&[&common[..], &BOTH, arguments].concat());
    let controller = bench.await_ticks("controller");
    assert_eq!(bench.role("observer"), None, "the observer has no process of its own");
    send_signal(controller, SIGKILL);
    running
}

#[test]
fn a_killed_process_restarts_with_both_roles() {
    let accept = format!("--set=accept={{settled_by_s=0,sync_error_rad_s_max=3,{ANY_TICKS}}}");
    let slow: &[&str] = &["--duration=4", "--tick-hz=200", &accept];
    let endless: &[&str] = &["--duration=100000", "--set=accept={}"];
    for (clock, arguments) in [("realtime", slow), ("lockstep", endless)] {
        let bench = Bench::new();
        let running = start_and_kill(&bench, &[&["--clock", clock][..], arguments].concat());
        if clock == "lockstep" {
            await_some(|| (bench.processes().len() == 4).then_some(()));
            await_some(|| (bench.processes().len() == 5).then_some(()));
            bench.await_commits("controller", bench.commits("controller") + 1000);
            running.signal(SIGTERM);
        }
        let done = running.wait();
        assert_eq!(done.code, Some(if clock == "lockstep" { 128 + SIGTERM } else { 0 }), "{clock}: {done:?}");
        let summary = done.json();
        let incident = &summary["incidents"][0];
        assert_eq!((&incident["role"], &incident["with"][0]), (&"controller".into(), &"observer".into()), "{clock}");
        assert_eq!(incident["action"], "restarted", "{clock}");
        let printed = done.stderr.lines().find(|line| line.ends_with("[killed]")).expect("the incident is printed");
        assert!(["controller", "observer"].iter().all(|role| printed.contains(role)), "{clock}: {printed}");
        assert!(incident["outage_s"].is_number(), "{clock}: {incident}");
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 1, "{clock}");
        assert_eq!(summary["books"]["balanced"], true, "{clock}: {:#}", summary["books"]);
        for role in ["observer", "controller"] {
            let ticks = &summary["books"]["roles"][role];
            match clock {
                "lockstep" => assert!(ticks["missed"] == 0 && ticks["first_disturbed"].is_null(), "{role}: {ticks}"),
                _ => {
                    let disturbed = ticks["first_disturbed"].as_u64().expect("ticks were missed");
                    assert!(ticks["executed"].as_u64().unwrap() > disturbed, "{role} continues: {ticks}");
                }
            }
        }
        bench.assert_clean(&[]);
    }
}

/// If the policy of either role forbids a restart, the run ends.
#[test]
fn the_stricter_failure_policy_applies() {
    let bench = Bench::new();
    let policy = "--set=supervision.on_failure={observer=\"stop\"}";
    let done = start_and_kill(&bench, &["--clock=realtime", "--duration=1000", "--set=accept={}", policy]).wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["incidents"][0]["action"], "stopped");
    assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
    assert!(
        summary["books"]["roles"]["observer"]["executed"].as_u64().unwrap() > 0,
        "the counters of dead roles are read, too"
    );
    bench.assert_clean(&[]);
}

/// Kills the process at every failpoint of a tick: no sample that another role needs is lost.
#[cfg(feature = "hooks")]
#[test]
fn in_lockstep_a_death_at_any_point_of_a_tick_changes_nothing() {
    let undisturbed = Bench::new().summary("rigid-pair", &["--clock", "lockstep"]);
    // Observer and controller pass them in turn: odd counts are the observer's, even ones the controller's.
    let places = ["staged", "committing", "in-commit", "committed", "sent"];
    let places = places.iter().flat_map(|place| [901, 902].map(|count| format!("{place} {count}")));
    let places: Vec<String> = places.chain(["waiting 40".to_owned()]).collect();
    let cases =
        [BOTH, ALL, CROSSED].into_iter().flat_map(|processes| places.iter().map(move |place| (processes, place)));
    for (processes, place) in cases {
        // In a single process no role waits for long.
        if processes == ALL && place.starts_with("waiting") {
            continue;
        }
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let mut command = bench.command();
        command.args(["run", file.to_str().unwrap(), "--json", "--out", "out", "--clock", "lockstep"]).args(processes);
        // A role that is silent for long on a loaded machine must not be restarted.
        command.arg("--set=supervision.heartbeat_timeout_s=60");
        command.env("COROTATE_HOOK", format!("observer {place} KILL"));
        let done = Running::new(&mut command).wait();
        assert_eq!(done.code, Some(0), "{place}: {done:?}");
        let summary = done.json();
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 1, "{place}: {done:?}");
        assert_eq!(summary["books"]["balanced"], true, "{place}: {:#}", summary["books"]);
        assert_eq!(summary["books"]["missed_ticks"], 0, "{place}");
        assert_eq!(summary["score"]["unscored_ticks"], 0, "{place}");
        for part in ["/state/hash", "/books/roles", "/books/links", "/score/metrics"] {
            assert_eq!(summary.pointer(part), undisturbed.pointer(part), "{place}: {part}");
        }
        bench.assert_clean(&[]);
    }
}

#[test]
fn roles_that_cannot_share_a_process_are_refused() {
    let bench = Bench::new();
    let assert_refused = |arguments: &[&str], code: &str, words: &[&str]| {
        let done = bench.run(arguments);
        assert!(done.code == Some(2) && done.says(code), "{arguments:?}: {done:?}");
        for word in words {
            assert!(done.stderr.contains(word), "{arguments:?}: `{word}` is not in {}", done.stderr);
        }
    };
    let path = |name: &str| shipped(name).to_str().unwrap().to_owned();
    let (pair, alone) = (path("rigid-pair"), path("inertia"));
    for role in ["observer", "controller"] {
        let code = "shared-and-external";
        assert_refused(&["run", &pair, BOTH[0], BOTH[1], "--external", role], code, &["--external", role]);
        let list = format!("--set=launch.external=[\"{role}\"]");
        assert_refused(&["run", &pair, BOTH[0], BOTH[1], &list], code, &["launch.processes[0]", role]);
        assert_refused(&["seat", &pair, role, BOTH[0], BOTH[1]], code, &[role]);
    }
    let processes = |value: &str| format!("--set=launch.processes={value}");
    for (scenario, value, code, key) in [
        (&alone, "[['observer','controller']]", "unknown-role", "launch.processes[0][1]"),
        (&pair, "[['leader']]", "role-alone", "launch.processes[0]"),
        (&pair, "[['leader','observer'],['observer','controller']]", "role-twice", "launch.processes[1][0]"),
        (&pair, "['leader']", "wrong-type", "launch.processes[0]"),
    ] {
        assert_refused(&["run", scenario, &processes(value)], code, &[&format!(" {key}: ")]);
    }
    assert_refused(&["run", &pair, "--set=launch.process=[]"], "unknown-key", &["`processes`"]);
}

/// The follower is external; the observer of a shared process cannot be started separately.
#[test]
fn an_external_follower_joins_and_a_hosted_observer_does_not() {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let arguments = ["run", file.to_str().unwrap(), "--clock=lockstep", "--duration=1", "--set=accept={}", "--json"];
    let running = bench.start(&[&arguments[..], &BOTH, &["--external", "follower"]].concat());
    bench.await_role("controller");
    let domains = bench.domains();
    let domain = domains[0].to_str().unwrap();
    let observer = bench.run(&["observer", "--domain", domain]);
    assert_eq!(observer.code, Some(2), "{observer:?}");
    assert!(observer.says("hosted-role"), "{observer:?}");
    let follower = bench.run(&["plant", "--body", "follower", "--domain", domain]);
    let done = running.wait();
    assert_eq!((follower.code, done.code), (Some(0), Some(0)), "{follower:?} {done:?}");
    assert_eq!(done.json()["books"]["balanced"], true);
    bench.assert_clean(&domains);
}
