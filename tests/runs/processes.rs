//! A run as processes, from outside: signals, killed roles, a killed launcher, two runs at once, roles started by hand.
//! After each of them nothing may be left: no process, no file.

use crate::common::{Bench, Running, await_some, send_signal, shipped, skipped};
use libc::{SIGINT, SIGKILL, SIGSTOP, SIGTERM};
use std::path::PathBuf;

fn start_endless(bench: &Bench, arguments: &[&str]) -> (Running, Vec<PathBuf>) {
    let running = bench.start_endless(arguments);
    let domains = bench.domains();
    assert_eq!(domains.len(), 1);
    (running, domains)
}

#[test]
fn a_signal_ends_a_run_in_order_with_its_results_written() {
    for (signal, clock) in [(SIGINT, "realtime"), (SIGTERM, "lockstep"), (SIGINT, "lockstep"), (SIGTERM, "realtime")] {
        let bench = Bench::new();
        let (running, domains) = start_endless(&bench, &["--clock", clock]);
        running.signal(signal);
        let done = running.wait();
        assert_eq!(done.code, Some(128 + signal), "{done:?}");
        assert!(done.says("interrupted"), "{done:?}");
        let summary = bench.summary_in("out");
        assert_eq!(summary["signal"], signal);
        assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
        for role in ["leader", "follower", "observer", "controller"] {
            assert!(summary["books"]["roles"][role]["executed"].as_u64().unwrap() > 0, "{role}");
        }
        bench.assert_clean(&domains);
    }
}

#[test]
fn an_in_process_run_ends_in_order_too() {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let arguments = ["run", file.to_str().unwrap(), "--clock", "in-process", "--duration", "10000000", "--out", "out"];
    let running = bench.start(&arguments);
    std::thread::sleep(std::time::Duration::from_millis(300));
    running.signal(SIGINT);
    let done = running.wait();
    assert_eq!(done.code, Some(130), "{done:?}");
    assert!(bench.path("out/summary.json").is_file());
    assert!(bench.domains().is_empty(), "an in-process run needs no domain");
}

#[test]
fn a_killed_role_ends_the_run_by_name_and_cause() {
    for role in ["leader", "follower", "observer", "controller"] {
        let bench = Bench::new();
        let (running, domains) = start_endless(&bench, &["--set", "supervision.on_failure=\"stop\""]);
        send_signal(bench.await_role(role), SIGKILL);
        let done = running.wait();
        assert_eq!(done.code, Some(4), "{done:?}");
        assert!(done.stderr.contains(&format!("{role} died at tick ")), "{done:?}");
        assert!(done.says("killed"), "{done:?}");
        let summary = bench.summary_in("out");
        assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
        assert_eq!(summary["incidents"][0]["role"], role);
        bench.assert_clean(&domains);
    }
}

#[test]
fn a_killed_launcher_takes_everything_with_it() {
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let (running, domains) = start_endless(&bench, &["--clock", clock]);
        running.signal(SIGKILL);
        assert_eq!(running.wait().signal, Some(SIGKILL));
        bench.assert_clean(&domains);
    }
}

/// Launcher and janitor both killed: the next run of the same user cleans up.
#[test]
fn the_next_run_removes_what_a_killed_janitor_could_not() {
    let bench = Bench::new();
    let (running, domains) = start_endless(&bench, &[]);
    send_signal(bench.await_role("janitor"), SIGKILL);
    running.signal(SIGKILL);
    running.wait();
    // The roles die by the kernel's hand at once.
    await_some(|| bench.processes().is_empty().then_some(()));
    assert_eq!(bench.domains(), domains, "this test is about a domain that is left");
    bench.summary("rigid-pair", &["--clock", "lockstep", "--duration", "0.1", "--set", "accept={}"]);
    bench.assert_clean(&domains);
}

/// A janitor that stands still is replaced when it is needed, and not waited for when it is not.
#[test]
fn a_janitor_that_stands_still_keeps_nobody() {
    for clock in ["realtime", "lockstep"] {
        for kills in [true, false] {
            let bench = Bench::new();
            let (running, domains) = start_endless(&bench, &["--clock", clock, "--json"]);
            let janitor = bench.await_role("janitor");
            send_signal(janitor, SIGSTOP);
            if kills {
                let killed = bench.await_role("controller");
                send_signal(killed, SIGKILL);
                await_some(|| (bench.await_role("controller") != killed).then_some(()));
                assert_ne!(bench.await_role("janitor"), janitor);
            }
            running.signal(SIGTERM);
            let done = running.wait();
            assert_eq!(done.code, Some(128 + SIGTERM), "{clock} {kills}: {done:?}");
            let summary = done.json();
            assert_eq!(summary["incidents"].as_array().unwrap().len(), usize::from(kills), "{clock}: {done:?}");
            bench.assert_clean(&domains);
        }
    }
}

#[test]
fn two_runs_at_once_do_not_meet() {
    for clock in ["lockstep", "realtime"] {
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let start = |out: &str| {
            let common = ["--duration", "3", "--set", "accept={}", "--json", "--out", out];
            bench.start(&[&["run", file.to_str().unwrap(), "--clock", clock][..], &common].concat())
        };
        let summaries = [start("a"), start("b")].map(|run| {
            let done = run.wait();
            assert_eq!(done.code, Some(0), "{clock}: {done:?}");
            done.json()
        });
        assert_ne!(summaries[0]["domain"], summaries[1]["domain"]);
        assert!(summaries.iter().all(|summary| summary["books"]["balanced"] == true), "{clock}");
        // In real time each may miss ticks of its own; up to there they are one.
        if clock == "lockstep" {
            assert_eq!(summaries[0]["state"]["hash"], summaries[1]["state"]["hash"]);
        }
        bench.assert_clean(&[]);
    }
}

/// Two default runs in one directory get result directories of their own.
#[test]
fn runs_of_the_same_second_do_not_overwrite_each_other() {
    let bench = Bench::new();
    let run = || bench.start(&["run", shipped("rigid-pair").to_str().unwrap(), "--clock", "in-process"]);
    for run in [run(), run(), run()] {
        assert_eq!(run.wait().code, Some(0));
    }
    // And the link to the newest of them.
    assert_eq!(std::fs::read_dir(bench.path("runs")).unwrap().count(), 3 + 1);
}

#[test]
fn a_role_can_be_started_by_hand() {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let run =
        ["run", file.to_str().unwrap(), "--clock", "lockstep", "--json", "--external", "observer", "--out", "out"];
    let running = bench.start(&run);
    bench.await_role("controller");
    let domain = bench.domains().remove(0);
    let by_hand = bench.start(&["observer", "--domain", domain.to_str().unwrap()]);
    let (run, role) = (running.wait(), by_hand.wait());
    assert_eq!((run.code, role.code), (Some(0), Some(0)), "{run:?} {role:?}");
    assert!(run.stderr.contains("corotate observer --domain"), "{run:?}");
    let summary = run.json();
    assert_eq!(summary["books"]["roles"]["observer"]["executed"], 10_001);
    assert_eq!(summary["state"]["hash"], bench.summary("rigid-pair", &["--clock", "in-process"])["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

/// Every program that takes a seat in the midst of a run is told, by its process and the tick of its first sample.
#[test]
fn a_role_by_hand_that_is_replaced_is_told_each_time() {
    const LIVES: usize = 4;
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let endless = ["--tick-hz", "200", "--duration", "100000", "--out", "out", "--set", "accept={}"];
        // A role may be away for long on a loaded machine.
        let patient = ["--set", "supervision.heartbeat_timeout_s=60", "--external", "follower", "--json"];
        let run = bench.start(&[&["run", file.to_str().unwrap(), "--clock", clock], &endless[..], &patient].concat());
        let domain = await_some(|| bench.domains().pop());
        let (mut pids, mut last) = (Vec::new(), None);
        for _ in 0..LIVES {
            if let Some(before) = last.take() {
                let before: Running = before;
                before.signal(SIGKILL);
                before.wait();
            }
            let follower = bench.start(&["plant", "--body", "follower", "--domain", domain.to_str().unwrap()]);
            pids.push(u64::from(follower.pid()));
            bench.await_commits("follower", bench.commits("follower") + 100);
            last = Some(follower);
        }
        run.signal(SIGTERM);
        let (run, _) = (run.wait(), last.map(Running::wait));
        assert_eq!(run.code, Some(128 + SIGTERM), "{clock}: {run:?}");
        let summary = run.json();
        let incidents = summary["incidents"].as_array().unwrap();
        let by: Vec<_> = incidents.iter().map(|one| one["replaced_by"]["pid"].as_u64().unwrap()).collect();
        assert_eq!(by, pids[1..], "{clock}: {incidents:?}");
        for incident in incidents {
            let [left, back] = [&incident["tick"], &incident["replaced_by"]["tick"]].map(|tick| tick.as_u64().unwrap());
            assert_eq!((&incident["role"], &incident["action"]), (&"follower".into(), &"continued".into()));
            let time_s = incident["time_s"].as_f64().unwrap();
            assert!(left > 0 && back >= left && (time_s - left as f64 / 200.0).abs() < 1e-9, "{incident}");
            assert!(incident["outage_s"].as_f64().unwrap() > 0.0, "{incident}");
        }
        bench.assert_clean(&[domain]);
    }
}

/// A real-time priority is refused to an ordinary user without a limit that allows it.
const UNGRANTABLE: [&str; 2] = ["--set", "realtime.priority=99"];

/// Nobody starts it, so nobody ends it: it notices by itself that nobody is left.
#[test]
fn a_role_by_hand_does_not_outlive_a_killed_launcher() {
    for clock in ["lockstep", "realtime"] {
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let endless = ["--duration", "100000", "--out", "out", "--set", "accept={}", "--external", "follower"];
        let run = bench.start(&[&["run", file.to_str().unwrap(), "--clock", clock], &endless[..]].concat());
        let domain = await_some(|| bench.domains().pop());
        let follower = bench.start(&["plant", "--body", "follower", "--domain", domain.to_str().unwrap()]);
        bench.await_ticks("controller");
        run.signal(SIGKILL);
        run.wait();
        let done = follower.wait();
        assert!(done.code == Some(1) && done.says("run-gone"), "{clock}: {done:?}");
        bench.assert_clean(&[domain]);
    }
}

/// Whoever joins a run at its very end may have missed its last word.
#[test]
fn who_joins_a_run_that_ends_ends_too() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "20", "--set", "accept={}"];
    for attempt in 0..12 {
        let run = bench.start(&words);
        let domain = await_some(|| bench.domains().pop());
        // Not to wait for anything: each attempt joins at another place of the run.
        std::thread::sleep(std::time::Duration::from_millis(30 * attempt));
        let domain = domain.to_str().unwrap();
        let record = bench.start(&["record", "--domain", domain, "--out", "part.mcap", "--overwrite"]);
        let watch = bench.start(&["watch", domain, "--once", "600"]);
        for joiner in [record, watch] {
            let done = joiner.wait();
            assert!(done.signal.is_none(), "{done:?}");
        }
        run.wait().succeeded();
    }
    bench.assert_clean(&[]);
}

#[test]
fn a_privilege_that_is_not_granted_is_told_and_only_fails_a_run_that_requires_it() {
    let bench = Bench::unprivileged();
    let words = ["run", "rigid-pair", "--duration", "0.2", "--set", "accept={}", "--clock", "realtime", "--json"];
    let run = |more: &[&str]| bench.run(&[&words[..], &UNGRANTABLE, more].concat());
    let done = run(&[]).succeeded();
    let summary = done.json();
    let denied = summary["privileges"].as_array().unwrap().iter().filter(|grant| grant["granted"] == false);
    let fifo = denied.clone().filter(|grant| grant["privilege"] == "SCHED_FIFO").count();
    if fifo == 0 {
        return skipped("a privilege that is not granted", "this user has real-time priority 99");
    }
    assert!(denied.clone().all(|grant| !grant["reason"].as_str().unwrap().is_empty()));
    let done = run(&["--require-rt"]);
    assert!(done.code == Some(5) && done.says("privilege-denied"), "{done:?}");
    bench.assert_clean(&[]);
}

#[test]
fn cores_that_are_not_there_are_refused_before_anything_starts() {
    let bench = Bench::new();
    let cores = ["--set", "realtime.cores=[0,1023]"];
    for command in [&["run", "rigid-pair", "--out", "out"][..], &["check", "rigid-pair"]] {
        let done = bench.run(&[command, &cores].concat());
        assert!(done.code == Some(2) && done.says("no-such-core"), "{done:?}");
    }
    assert!(!bench.path("out").exists());
    let elsewhere = ["run", "rigid-pair", "--clock", "lockstep", "--duration=0.1", "--set=accept={}"];
    assert_eq!(bench.run(&[&elsewhere[..], &cores].concat()).code, Some(0), "only real time binds roles to cores");
}

#[test]
fn a_criterion_that_does_not_hold_gives_exit_code_3_and_says_which() {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let set = ["--set", "accept.settled_by_s=0.5", "--set", "accept.sync_error_rad_s_max=1e-6"];
    for clock in ["in-process", "lockstep", "realtime"] {
        let run = [&["run", file.to_str().unwrap(), "--duration", "1", "--clock", clock][..], &set].concat();
        let done = bench.run(&run);
        assert_eq!(done.code, Some(3), "{done:?}");
        assert!(done.says("not-met"), "{done:?}");
        assert!(done.stdout.contains("FAILS"), "{done:?}");
    }
    bench.assert_clean(&[]);
}

/// The job of the whole program: the hidden component is never published, and yet the bodies synchronise.
#[test]
fn the_follower_synchronises_in_real_time_with_a_component_that_nobody_measures() {
    let bench = Bench::new();
    let summary = bench.summary("rigid-pair", &["--set", "accept={}", "--out", "out"]);
    assert_eq!(summary["clock"], "realtime");
    let metric = &summary["score"]["metrics"][0];
    assert_eq!(metric["name"], "sync_error_rad_s");
    let (error, books) = (metric["last"].as_f64().unwrap(), &summary["books"]);
    let missed = books["missed_ticks"].as_u64().unwrap();
    println!("{error:e} rad/s at the end, {missed} of 40004 ticks missed or starved");
    assert_eq!(books["balanced"], true, "{summary:#}");
    // A machine that withholds the processor for much of the run gives a slower loop, and says so; never an unstable one.
    let limit = if missed < 2000 { 1e-9 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let stages: Vec<(&str, &str)> = summary["latencies"]
        .as_array()
        .unwrap()
        .iter()
        .map(|stage| (stage["role"].as_str().unwrap(), stage["stage"].as_str().unwrap()))
        .collect();
    for stage in [
        ("leader", "baseline"),
        ("leader", "lateness"),
        ("follower", "lateness"),
        ("follower", "age"),
        ("observer", "hop"),
        ("observer", "step"),
        ("controller", "hop"),
        ("controller", "step"),
        ("controller", "age"),
    ] {
        assert!(stages.contains(&stage), "{stage:?} in {stages:?}");
        let file = bench.path(&format!("out/latency/{}.{}.hgrm", stage.0, stage.1));
        assert!(std::fs::read_to_string(file).unwrap().contains("#[Max"), "{stage:?}");
    }
    assert!(std::fs::read_to_string(bench.path("out/latency/latency.hlog")).unwrap().contains("Tag=observer.step"));
    bench.assert_clean(&[]);
}

/// Every tick has an entry in every stage, also those that a controller which stands still for 20 ms misses, and those that a
/// follower spends with an old command: nothing is omitted because a role was absent.
#[test]
fn every_stage_counts_every_tick() {
    let bench = Bench::new();
    let stall = "fault=[{kind=\"stall\", role=\"controller\", from_tick=300, stall_ms=20.0}]";
    let summary = bench.summary("rigid-pair", &["--duration", "1", "--set", "accept={}", "--set", stall]);
    let stages = summary["latencies"].as_array().unwrap();
    let find = |role: &str, stage: &str| {
        stages.iter().find(|found| found["role"] == role && found["stage"] == stage).unwrap().clone()
    };
    for (role, told) in [
        ("leader", &["lateness", "step"][..]),
        ("follower", &["lateness", "step"]),
        ("observer", &["hop", "step", "age"]),
        ("controller", &["hop", "step", "age"]),
    ] {
        told.iter().for_each(|stage| assert_eq!(find(role, stage)["count"], 1001, "{role} {stage}"));
    }
    for (role, stage) in [("controller", "hop"), ("controller", "step"), ("controller", "age"), ("follower", "age")] {
        let found = find(role, stage);
        let us = |key: &str| found[key].as_f64().unwrap();
        assert!(us("max_us") > 15e3 && us("p99_us") > 5e3 && us("missed") > 10.0, "{found:#}");
        assert_eq!(found["ahead"], 0, "{found:#}");
    }
}

/// The resolved scenario in the run directory is the run: it gives the same bits again.
#[test]
fn the_resolved_scenario_repeats_the_run() {
    let bench = Bench::new();
    let first = bench.summary("rigid-trio", &["--clock", "lockstep", "--out", "first"]);
    let again = bench.path("first/scenario.toml");
    let done = bench.run(&["run", again.to_str().unwrap(), "--clock", "in-process", "--json"]);
    let again = done.json();
    assert_eq!(first["state"]["hash"], again["state"]["hash"]);
}

/// The truth has one reader, the scorer: asked of the transport itself, while the loop runs.
#[test]
fn the_truth_is_open_to_the_scorer_alone() {
    use iceoryx2::prelude::*;
    let bench = Bench::new();
    let (running, domains) = start_endless(&bench, &["--clock", "realtime"]);
    let mut config = Config::default();
    config.global.set_root_path(&Path::new(domains[0].to_str().unwrap().as_bytes()).unwrap());
    let id = domains[0].file_name().unwrap().to_str().unwrap();
    config.global.prefix = FileName::new(format!("corotate_{id}_").as_bytes()).unwrap();
    let parties = |signal: &str| {
        let mut parties = None;
        ipc::Service::list(&config, |service| {
            if service.static_details.name().as_str() == format!("corotate/rigid-pair/leader/{signal}") {
                parties = Some(service.dynamic_details.unwrap().nodes.len());
            }
            CallbackProgression::Continue
        })
        .unwrap();
        parties.unwrap()
    };
    assert_eq!(parties("truth"), 2, "the leader and the launcher");
    assert_eq!(parties("estimate"), 3, "observer, controller and launcher");
    running.signal(SIGTERM);
    running.wait();
    bench.assert_clean(&domains);
}

/// Without any privilege (as nobody, where the test itself runs as root) everything works, and every refusal is told.
#[test]
fn a_run_without_privileges_works_and_says_what_it_lacks() {
    let bench = Bench::unprivileged();
    let summary = bench.summary("rigid-pair", &["--duration", "1", "--set", "accept={}", "--clock", "realtime"]);
    let fifo = summary["privileges"].as_array().unwrap().iter().filter(|grant| grant["privilege"] == "SCHED_FIFO");
    assert_eq!(fifo.clone().count(), 4);
    if rustix::process::getuid().is_root() {
        assert!(fifo.clone().all(|grant| grant["granted"] == false && grant["reason"] != ""), "{summary:#}");
    } else {
        skipped("the refusal of SCHED_FIFO", "only root knows a user who has no privilege, nobody");
    }
    assert_eq!(summary["books"]["balanced"], true);
    bench.assert_clean(&[]);
}

/// Neither the observer nor the controller reads the truth: their books name every signal they read.
#[test]
fn the_truth_is_read_by_nobody_in_the_loop() {
    let bench = Bench::new();
    let summary = bench.summary("rigid-trio", &["--clock", "lockstep", "--duration", "0.5", "--set", "accept={}"]);
    let links = summary["books"]["links"].as_array().unwrap();
    assert_eq!(links.len(), 6, "leader -> observer -> controller, and both ways for two followers: {links:?}");
    for link in links {
        assert!(!link["service"].as_str().unwrap().ends_with("/truth"), "{link}");
    }
}
