//! Roles that share a process (`launch.processes`), any of them: the same bits and the same books under every clock, one life
//! for all of them, and no room for anybody else.

use crate::common::{ANY_TICKS, Bench, Running, await_some, send_signal, shipped};
use libc::{SIGKILL, SIGTERM};

const BOTH: [&str; 2] = ["--set", "launch.processes=[['observer','controller']]"];
const ALL: [&str; 2] = ["--set", "launch.processes=[['leader','follower','observer','controller']]"];
const CROSSED: [&str; 2] = ["--set", "launch.processes=[['leader','controller'],['follower','observer']]"];
const HALVES: [&str; 2] = ["--set", "launch.processes=[['leader','follower'],['observer','controller']]"];

/// The hash after every tick.
fn checkpoints(bench: &Bench, directory: &str) -> Vec<String> {
    let text = std::fs::read_to_string(bench.path(directory).join("hashes.txt")).unwrap();
    text.lines().skip(1).map(str::to_owned).collect()
}

/// One follower, two of them, a fleet, a spacecraft that is leader and driven body in one, and every kind of fault; and the
/// roles of each in pairs across the chain, and all in one process.
#[test]
fn the_bits_and_the_books_are_those_of_processes_apart_and_of_one_thread() {
    for scenario in ["rigid-pair", "rigid-trio", "rigid-fleet", "orbit-hold", "faults"] {
        let bench = Bench::new();
        let length: &[&str] = if scenario == "faults" { &[] } else { &["--duration", "1", "--set", "accept={}"] };
        let run = |clock: &str, more: &[&str]| bench.summary(scenario, &[length, &["--clock", clock], more].concat());
        let apart = run("lockstep", &[]);
        let roles: Vec<String> =
            apart["books"]["roles"].as_object().unwrap().keys().map(|name| format!("'{name}'")).collect();
        let crossed: Vec<String> = roles.iter().step_by(2).cloned().collect();
        let processes = |names: &[String]| format!("launch.processes=[[{}]]", names.join(","));
        let (all, crossed) = (processes(&roles), processes(&crossed));
        for shared in [BOTH[1], &all, &crossed] {
            let shared = ["--set", shared];
            let (one, together) = (run("in-process", &shared), run("lockstep", &shared));
            for other in [&one, &apart] {
                assert_eq!(together["state"], other["state"], "{scenario} {shared:?}");
                assert_eq!(together["books"]["roles"], other["books"]["roles"], "{scenario} {shared:?}");
                assert_eq!(together["score"], other["score"], "{scenario} {shared:?}");
                assert!(other["hosted"].is_null(), "{scenario}: roles in one thread are in nobody's process");
            }
            assert_eq!(together["books"]["links"], apart["books"]["links"], "{scenario} {shared:?}");
            assert_eq!(together["books"]["balanced"], true, "{scenario} {shared:?}");
            assert!(together["hosted"].as_object().is_some_and(|hosted| !hosted.is_empty()), "{scenario} {shared:?}");
        }
        bench.assert_clean(&[]);
    }
}

#[test]
fn in_real_time_the_bits_are_the_same_up_to_the_first_missed_tick_and_all_roles_tell_their_latencies() {
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
        for (role, told) in [
            ("leader", &["baseline", "lateness", "step"][..]),
            ("follower", &["lateness", "age", "step"]),
            ("observer", &["hop", "step", "age"]),
            ("controller", &["hop", "step", "age"]),
        ] {
            let ticks = &live["books"]["roles"][role];
            let [executed, elapsed] = ["executed", "elapsed"].map(|key| ticks[key].as_u64().unwrap());
            for stage in told {
                let found = stages.iter().find(|found| found["role"] == role && found["stage"] == *stage);
                let count = found.map_or(0, |found| found["count"].as_u64().unwrap());
                match (role, *stage) {
                    // Every wake is told, and every tick of the observer.
                    ("leader", _) => assert!((1..=2001).contains(&count), "{out} {role} {stage}: {count}"),
                    ("observer", _) => assert_eq!(count, elapsed, "{out} {role} {stage}"),
                    _ => assert!(
                        (executed.min(1)..=2001).contains(&count),
                        "{out} {role} {stage}: {count} of {executed}"
                    ),
                }
            }
        }
        let asked = |role: &str| live["privileges"].as_array().unwrap().iter().any(|grant| grant["role"] == role);
        assert!(asked(host_of_observer), "{out}: {}", live["privileges"]);
        let hosted: Vec<&String> = live["hosted"].as_object().unwrap().keys().collect();
        assert!(hosted.iter().all(|role| !asked(role)), "{out}: what was asked was asked once: {}", live["privileges"]);
    }
    bench.assert_clean(&[]);
}

/// Starts a run and kills the one process of both roles amid the ticks.
fn killed(bench: &Bench, arguments: &[&str]) -> Running {
    let file = shipped("rigid-pair");
    let common = ["run", file.to_str().unwrap(), "--json", "--out", "out"];
    let running = bench.start(&[&common[..], &BOTH, arguments].concat());
    let controller = bench.await_ticks("controller");
    // Leader, follower, both in one, launcher, janitor.
    assert_eq!(bench.processes().len(), 5, "nobody is an observer alone");
    send_signal(controller, SIGKILL);
    running
}

#[test]
fn whoever_kills_the_process_kills_both_and_both_come_back() {
    let accept = format!("--set=accept={{settled_by_s=0,sync_error_rad_s_max=3,{ANY_TICKS}}}");
    let slow: &[&str] = &["--duration=4", "--tick-hz=200", &accept];
    let endless: &[&str] = &["--duration=100000", "--set=accept={}"];
    for (clock, arguments) in [("realtime", slow), ("lockstep", endless)] {
        let bench = Bench::new();
        let running = killed(&bench, &[&["--clock", clock][..], arguments].concat());
        if clock == "lockstep" {
            await_some(|| (bench.processes().len() == 4).then_some(()));
            await_some(|| (bench.processes().len() == 5).then_some(()));
            bench.await_commits("controller", bench.commits("controller") + 1000);
            running.signal(SIGTERM);
        }
        let done = running.wait();
        assert_eq!(done.code, Some(if clock == "lockstep" { 128 + SIGTERM } else { 0 }), "{clock}: {done:?}");
        assert!(done.stderr.contains("controller, and observer with it, died at tick "), "{clock}: {done:?}");
        let summary = done.json();
        let incident = &summary["incidents"][0];
        assert_eq!((&incident["role"], &incident["with"][0]), (&"controller".into(), &"observer".into()), "{clock}");
        assert_eq!(incident["action"], "restarted", "{clock}");
        assert!(incident["outage_s"].is_number(), "{clock}: {incident}");
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 1, "{clock}");
        assert_eq!(summary["books"]["balanced"], true, "{clock}: {:#}", summary["books"]);
        for role in ["observer", "controller"] {
            let ticks = &summary["books"]["roles"][role];
            match clock {
                "lockstep" => assert!(ticks["missed"] == 0 && ticks["first_disturbed"].is_null(), "{role}: {ticks}"),
                _ => {
                    let disturbed = ticks["first_disturbed"].as_u64().expect("ticks were missed");
                    assert!(ticks["executed"].as_u64().unwrap() > disturbed, "{role} went on: {ticks}");
                }
            }
        }
        bench.assert_clean(&[]);
    }
}

/// One life: whichever of the two must not be started anew ends the run.
#[test]
fn the_stricter_of_both_policies_holds() {
    let bench = Bench::new();
    let policy = "--set=supervision.on_failure={observer=\"stop\"}";
    let done = killed(&bench, &["--clock=realtime", "--duration=1000", "--set=accept={}", policy]).wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["incidents"][0]["action"], "stopped");
    assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
    assert!(
        summary["books"]["roles"]["observer"]["executed"].as_u64().unwrap() > 0,
        "the books of the dead are read too"
    );
    bench.assert_clean(&[]);
}

/// At every place of a tick, whichever of them is there: nothing is lost that another still needs.
#[cfg(feature = "hooks")]
#[test]
fn in_lockstep_all_may_die_anywhere_in_a_tick() {
    let undisturbed = Bench::new().summary("rigid-pair", &["--clock", "lockstep"]);
    // Passed by the two in turn: odd is the estimate's, even the command's.
    let places = ["staged", "committing", "in-commit", "committed", "sent"];
    let places = places.iter().flat_map(|place| [901, 902].map(|count| format!("{place} {count}")));
    let places: Vec<String> = places.chain(["waiting 40".to_owned()]).collect();
    let cases =
        [BOTH, ALL, CROSSED].into_iter().flat_map(|processes| places.iter().map(move |place| (processes, place)));
    for (processes, place) in cases {
        // Nobody waits for long where all is in one process.
        if processes == ALL && place.starts_with("waiting") {
            continue;
        }
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let mut command = bench.command();
        command.args(["run", file.to_str().unwrap(), "--json", "--out", "out", "--clock", "lockstep"]).args(processes);
        // Whoever is silent for long on a loaded machine is no death of this test.
        command.arg("--set=supervision.heartbeat_timeout_s=60");
        command.env("COROTATE_HOOK", format!("observer {place} KILL"));
        let done = Running::new(&mut command).wait();
        assert_eq!(done.code, Some(0), "{place}: {done:?}");
        let summary = done.json();
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 1, "{place}: {done:?}");
        assert_eq!(summary["books"]["balanced"], true, "{place}: {:#}", summary["books"]);
        assert_eq!(summary["books"]["missed_ticks"], 0, "{place}");
        assert_eq!(summary["score"]["unscored_ticks"], 0, "{place}");
        for told in ["/state/hash", "/books/roles", "/books/links", "/score/metrics"] {
            assert_eq!(summary.pointer(told), undisturbed.pointer(told), "{place}: {told}");
        }
        bench.assert_clean(&[]);
    }
}

#[test]
fn what_cannot_share_a_process_is_refused_with_its_reason() {
    let bench = Bench::new();
    let refused = |arguments: &[&str], words: &[&str]| {
        let done = bench.run(arguments);
        assert_eq!(done.code, Some(2), "{arguments:?}: {done:?}");
        for word in words {
            assert!(done.stderr.contains(word), "{arguments:?}: `{word}` is not in {}", done.stderr);
        }
    };
    let path = |name: &str| shipped(name).to_str().unwrap().to_owned();
    let (pair, alone) = (path("rigid-pair"), path("inertia"));
    for role in ["observer", "controller"] {
        let why = "[shared-and-external]";
        refused(&["run", &pair, BOTH[0], BOTH[1], "--external", role], &["--external", role, why]);
        let list = format!("--set=launch.external=[\"{role}\"]");
        refused(&["run", &pair, BOTH[0], BOTH[1], &list], &["launch.processes[0]", role, why]);
        refused(&["seat", &pair, role, BOTH[0], BOTH[1]], &[role, why]);
    }
    refused(
        &["run", &alone, BOTH[0], BOTH[1]],
        &["launch.processes[0][1]", "there is no role `controller`", "observer"],
    );
    refused(&["run", &pair, "--set=launch.processes=[['leader']]"], &["launch.processes[0]", "name two roles or more"]);
    let twice = "--set=launch.processes=[['leader','observer'],['observer','controller']]";
    refused(&["run", &pair, twice], &["launch.processes[1][0]", "is listed twice", "list it once"]);
    refused(&["run", &pair, "--set=launch.processes=['leader']"], &["launch.processes[0]", "list"]);
    refused(&["run", &pair, "--set=launch.process=[]"], &["did you mean `processes`?"]);
}

/// The follower may still be anybody's; and nobody takes the observer's seat by hand.
#[test]
fn a_follower_by_hand_still_joins_and_an_observer_does_not() {
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
