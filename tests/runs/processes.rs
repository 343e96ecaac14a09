//! Runs in several processes: signals, killed roles and launchers, runs side by side, external roles, privileges.
//! After each run no process and no file may be left.

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
fn with_on_failure_stop_a_killed_role_ends_the_run() {
    for role in ["leader", "follower", "observer", "controller"] {
        let bench = Bench::new();
        let (running, domains) = start_endless(&bench, &["--set", "supervision.on_failure=\"stop\""]);
        send_signal(bench.await_role(role), SIGKILL);
        let done = running.wait();
        assert_eq!(done.code, Some(4), "{done:?}");
        assert!(done.says("killed"), "{done:?}");
        let summary = bench.summary_in("out");
        assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
        assert_eq!(summary["incidents"][0]["role"], role);
        bench.assert_clean(&domains);
    }
}

#[test]
fn nothing_outlives_a_killed_launcher() {
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let (running, domains) = start_endless(&bench, &["--clock", clock]);
        running.signal(SIGKILL);
        assert_eq!(running.wait().signal, Some(SIGKILL));
        bench.assert_clean(&domains);
    }
}

/// Launcher and janitor are both killed.
#[test]
fn the_next_run_of_the_user_removes_files_that_are_left() {
    let bench = Bench::new();
    let (running, domains) = start_endless(&bench, &[]);
    send_signal(bench.await_role("janitor"), SIGKILL);
    running.signal(SIGKILL);
    running.wait();
    // The kernel kills the roles at once.
    await_some(|| bench.processes().is_empty().then_some(()));
    assert_eq!(bench.domains(), domains, "the domain is left");
    bench.summary("rigid-pair", &["--clock", "lockstep", "--duration", "0.1", "--set", "accept={}"]);
    bench.assert_clean(&domains);
}

/// It is replaced if a role dies, and otherwise ignored.
#[test]
fn a_stopped_janitor_delays_no_restart_and_no_end() {
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
fn simultaneous_runs_do_not_affect_each_other() {
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
        // In real time each may miss different ticks.
        if clock == "lockstep" {
            assert_eq!(summaries[0]["state"]["hash"], summaries[1]["state"]["hash"]);
        }
        bench.assert_clean(&[]);
    }
}

#[test]
fn runs_of_the_same_second_get_different_results_directories() {
    let bench = Bench::new();
    let run = || bench.start(&["run", shipped("rigid-pair").to_str().unwrap(), "--clock", "in-process"]);
    for run in [run(), run(), run()] {
        assert_eq!(run.wait().code, Some(0));
    }
    // And the link `latest`.
    assert_eq!(std::fs::read_dir(bench.path("runs")).unwrap().count(), 3 + 1);
}

#[test]
fn an_external_role_can_be_started_by_hand() {
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
    assert!(run.stderr.contains("observer --domain"), "{run:?}");
    let summary = run.json();
    assert_eq!(summary["books"]["roles"]["observer"]["executed"], 10_001);
    assert_eq!(summary["state"]["hash"], bench.summary("rigid-pair", &["--clock", "in-process"])["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

/// The incident has the process of the successor and the tick of its first sample.
#[test]
fn each_replacement_of_an_external_role_is_an_incident() {
    const LIVES: usize = 4;
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let endless = ["--tick-hz", "200", "--duration", "100000", "--out", "out", "--set", "accept={}"];
        // On a loaded machine a role may be missing for long.
        let patient = ["--set", "supervision.heartbeat_timeout_s=60", "--external", "follower", "--json"];
        let run = bench.start(&[&["run", file.to_str().unwrap(), "--clock", clock], &endless[..], &patient].concat());
        let domain = bench.await_domain();
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
        let by: Vec<_> = incidents.iter().map(|incident| incident["replaced_by"]["pid"].as_u64().unwrap()).collect();
        assert_eq!(by, pids[1..], "{clock}: {incidents:?}");
        for incident in incidents {
            let [died, replaced] =
                [&incident["tick"], &incident["replaced_by"]["tick"]].map(|tick| tick.as_u64().unwrap());
            assert_eq!((&incident["role"], &incident["action"]), (&"follower".into(), &"continued".into()));
            let time_s = incident["time_s"].as_f64().unwrap();
            assert!(died > 0 && replaced >= died && (time_s - died as f64 / 200.0).abs() < 1e-9, "{incident}");
            assert!(incident["outage_s"].as_f64().unwrap() > 0.0, "{incident}");
        }
        bench.assert_clean(&[domain]);
    }
}

/// A priority that an ordinary user gets only if a resource limit allows it.
const UNGRANTABLE: [&str; 2] = ["--set", "realtime.priority=99"];

/// It is not a child of the launcher and must notice its end by itself.
#[test]
fn an_external_role_does_not_outlive_a_killed_launcher() {
    for clock in ["lockstep", "realtime"] {
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let endless = ["--duration", "100000", "--out", "out", "--set", "accept={}", "--external", "follower"];
        let run = bench.start(&[&["run", file.to_str().unwrap(), "--clock", clock], &endless[..]].concat());
        let domain = bench.await_domain();
        let follower = bench.start(&["plant", "--body", "follower", "--domain", domain.to_str().unwrap()]);
        bench.await_ticks("controller");
        run.signal(SIGKILL);
        run.wait();
        let done = follower.wait();
        assert!(done.code == Some(1) && done.says("run-gone"), "{clock}: {done:?}");
        bench.assert_clean(&[domain]);
    }
}

/// At the end of a run a joiner may miss the last message of the launcher.
#[test]
fn a_recorder_or_watcher_that_joins_at_the_end_does_not_hang() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "20", "--set", "accept={}"];
    for attempt in 0..12 {
        let run = bench.start(&words);
        let domain = bench.await_domain();
        // A delay, not a wait: each attempt joins at another point of the run.
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
fn a_denied_privilege_is_reported_and_fails_only_a_run_that_requires_it() {
    let bench = Bench::unprivileged();
    let words = ["run", "rigid-pair", "--duration", "0.2", "--set", "accept={}", "--clock", "realtime", "--json"];
    let run = |more: &[&str]| bench.run(&[&words[..], &UNGRANTABLE, more].concat());
    let done = run(&[]).succeeded();
    let summary = done.json();
    let denied = summary["privileges"].as_array().unwrap().iter().filter(|grant| grant["granted"] == false);
    let fifo = denied.clone().filter(|grant| grant["privilege"] == "SCHED_FIFO").count();
    if fifo == 0 {
        return skipped("a denied privilege", "this user has real-time priority 99");
    }
    assert!(denied.clone().all(|grant| !grant["reason"].as_str().unwrap().is_empty()));
    let done = run(&["--require-rt"]);
    assert!(done.code == Some(5) && done.says("privilege-denied"), "{done:?}");
    bench.assert_clean(&[]);
}

#[test]
fn a_missing_core_is_refused_before_the_run() {
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
fn an_unmet_criterion_gives_exit_code_3() {
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

/// The purpose of the program: one component of the leader's rate is neither measured nor published.
#[test]
fn in_real_time_the_follower_synchronises_with_an_unmeasured_component() {
    let bench = Bench::new();
    let summary = bench.summary("rigid-pair", &["--set", "accept={}", "--out", "out"]);
    assert_eq!(summary["clock"], "realtime");
    let metric = &summary["score"]["metrics"][0];
    assert_eq!(metric["name"], "sync_error_rad_s");
    let (error, books) = (metric["last"].as_f64().unwrap(), &summary["books"]);
    let missed = books["missed_ticks"].as_u64().unwrap();
    println!("{error:e} rad/s at the end, {missed} of 40004 ticks missed or starved");
    assert_eq!(books["balanced"], true, "{summary:#}");
    // With many missed ticks the loop is slower, but never unstable.
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

/// This includes the ticks that a stalled controller misses, and those in which the follower uses an old command.
#[test]
fn latencies_include_every_tick_also_missed_ones() {
    let bench = Bench::new();
    let stall = "fault=[{kind=\"stall\", role=\"controller\", from_tick=300, stall_ms=20.0}]";
    let summary = bench.summary("rigid-pair", &["--duration", "1", "--set", "accept={}", "--set", stall]);
    let stages = summary["latencies"].as_array().unwrap();
    let find = |role: &str, stage: &str| {
        stages.iter().find(|found| found["role"] == role && found["stage"] == stage).unwrap().clone()
    };
    for (role, reported) in [
        ("leader", &["lateness", "step"][..]),
        ("follower", &["lateness", "step"]),
        ("observer", &["hop", "step", "age"]),
        ("controller", &["hop", "step", "age"]),
    ] {
        reported.iter().for_each(|stage| assert_eq!(find(role, stage)["count"], 1001, "{role} {stage}"));
    }
    for (role, stage) in [("controller", "hop"), ("controller", "step"), ("controller", "age"), ("follower", "age")] {
        let found = find(role, stage);
        let us = |key: &str| found[key].as_f64().unwrap();
        assert!(us("max_us") > 15e3 && us("p99_us") > 5e3 && us("missed") > 10.0, "{found:#}");
        assert_eq!(found["ahead"], 0, "{found:#}");
    }
}

#[test]
fn the_resolved_scenario_of_a_run_gives_the_same_hash() {
    let bench = Bench::new();
    let first = bench.summary("rigid-trio", &["--clock", "lockstep", "--out", "first"]);
    let again = bench.path("first/scenario.toml");
    let done = bench.run(&["run", again.to_str().unwrap(), "--clock", "in-process", "--json"]);
    let again = done.json();
    assert_eq!(first["state"]["hash"], again["state"]["hash"]);
}

/// Asks the transport itself, during a run.
#[test]
fn only_the_scorer_opens_the_truth() {
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

/// Runs as the user `nobody` if the test runs as root.
#[test]
fn a_run_without_privileges_works_and_reports_each_denial() {
    let bench = Bench::unprivileged();
    let summary = bench.summary("rigid-pair", &["--duration", "1", "--set", "accept={}", "--clock", "realtime"]);
    let fifo = summary["privileges"].as_array().unwrap().iter().filter(|grant| grant["privilege"] == "SCHED_FIFO");
    assert_eq!(fifo.clone().count(), 4);
    if rustix::process::getuid().is_root() {
        assert!(fifo.clone().all(|grant| grant["granted"] == false && grant["reason"] != ""), "{summary:#}");
    } else {
        skipped("the denial of SCHED_FIFO", "only root can run as a user without privileges");
    }
    assert_eq!(summary["books"]["balanced"], true);
    bench.assert_clean(&[]);
}

/// The counters have an entry for every signal that a role reads.
#[test]
fn no_role_of_the_loop_reads_the_truth() {
    let bench = Bench::new();
    let summary = bench.summary("rigid-trio", &["--clock", "lockstep", "--duration", "0.5", "--set", "accept={}"]);
    let links = summary["books"]["links"].as_array().unwrap();
    assert_eq!(links.len(), 6, "leader -> observer -> controller, and both ways for two followers: {links:?}");
    for link in links {
        assert!(!link["service"].as_str().unwrap().ends_with("/truth"), "{link}");
    }
}
