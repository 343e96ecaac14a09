//! Recordings, read by independent programs and compared with what was published; replayed; cut off.

use crate::common::{
    Bench, Done, Loop, await_some, python, rewrite, rewrite_metadata, root, send_signal, shipped, skipped,
};
use corotate::bus::Reader;
use corotate::bus::memory::MemoryBus;
use corotate::clock::{Grid, monotonic_ns};
use corotate::record::{Recorder, Recording, RoleReplay, replay_in_process};
use corotate::runtime::{Poll, ReadyNode, RoleId, RunCondition, depths, ports, report, shared_ledger};
use corotate::sample::topic_of;
use corotate::scenario::Scenario;
use corotate::scenario::build;
use corotate::telemetry::Ledger;
use corotate::watch::Session;
use libc::{SIGCONT, SIGKILL, SIGSTOP};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Runs a shipped scenario with a recording. Returns the ended program and the file.
fn record(bench: &Bench, scenario: &str, out: &str, arguments: &[&str]) -> (Done, PathBuf) {
    let file = shipped(scenario);
    let common = ["run", file.to_str().unwrap(), "--record", "--overwrite", "--out", out, "--set", "accept={}"];
    (bench.run(&[&common, arguments].concat()), bench.path(out).join("run.mcap"))
}

fn replay(bench: &Bench, file: &Path, options: &[&str]) -> Done {
    bench.run(&[&["replay", file.to_str().unwrap()], options].concat())
}

/// Replays a recording with differences, and returns that of the first role that differs.
fn replay_difference(bench: &Bench, file: &Path, options: &[&str]) -> Value {
    let done = replay(bench, file, &[options, &["--json"]].concat());
    assert_eq!(done.code, Some(3), "{done:?}");
    let roles = done.json()["roles"].as_array().unwrap().clone();
    let role = roles.into_iter().find(|role| role["same"] == false).expect("a role differs");
    role["difference"].clone()
}

/// Runs a scenario in this thread without a recorder, and returns all published bytes by service.
fn published(scenario: &Scenario) -> BTreeMap<String, Vec<u8>> {
    let mut all = Loop::open(scenario);
    let writes = RoleId::all(scenario).into_iter().flat_map(|role| ports(scenario, role).writes);
    let mut taps: Vec<_> =
        writes.map(|port| (port.topic.to_string(), port.reader(&all.bus, Reader::Scorer).unwrap())).collect();
    let mut published: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    let grid = Grid { epoch_ns: 0, period_ns: scenario.period_ns };
    all.nodes.iter_mut().for_each(|node| node.start(grid, 0).unwrap());
    all.run(|_| {
        for (service, reader) in &mut taps {
            while let Some(words) = reader.next().unwrap() {
                published.entry(service.clone()).or_default().extend_from_slice(bytemuck::cast_slice(words));
            }
        }
    });
    published
}

#[test]
fn independent_readers_decode_every_sample_as_it_was_published() {
    let (bench, python) = (Bench::new(), python("readers"));
    for (scenario, clock) in [("rigid-pair", "lockstep"), ("orbit-rendezvous", "in-process"), ("gyro-loss", "lockstep")]
    {
        let overrides = [format!("clock={clock}"), "duration_s=1".to_owned(), "accept={}".to_owned()];
        let published = published(&Scenario::load(&shipped(scenario), &overrides).unwrap());
        let (done, file) = record(&bench, scenario, scenario, &["--clock", clock, "--duration", "1"]);
        assert_eq!(done.code, Some(0), "{done:?}");
        let decoded = bench.path(&format!("{scenario}.decoded"));
        std::fs::create_dir(&decoded).unwrap();
        let program = root().join("tests/readers/decode.py");
        let arguments = [program.to_str().unwrap(), file.to_str().unwrap(), decoded.to_str().unwrap()];
        bench.start_program(&python, &arguments).wait().succeeded();
        assert!(published.len() >= 5, "{}", published.len());
        for (service, bytes) in &published {
            for reader in ["mcap", "rosbags"] {
                let path = decoded.join(format!("{reader}{}", topic_of(service).replace('/', ".")));
                assert!(std::fs::read(&path).unwrap() == *bytes, "{scenario}: {service} by {reader}");
            }
        }
        assert_eq!(std::fs::read_dir(&decoded).unwrap().count(), 2 * published.len(), "no further signals");
    }
}

#[test]
fn a_run_by_every_clock_is_recorded_completely_and_replayed_to_the_last_bit() {
    let bench = Bench::new();
    for clock in ["in-process", "lockstep", "realtime"] {
        let (done, file) = record(&bench, "rigid-pair", clock, &["--clock", clock, "--duration", "1"]);
        assert_eq!(done.code, Some(0), "{done:?}");
        let recording = &bench.summary_in(clock)["recording"];
        assert_eq!(recording["complete"], true, "{recording}");
        for signal in recording["signals"].as_array().unwrap() {
            assert_eq!(signal["recorded"], signal["published"], "{signal}");
        }
        for options in [&[][..], &["--processes"]] {
            let done = replay(&bench, &file, &[options, &["--json"]].concat());
            assert_eq!(done.code, Some(0), "{clock} {options:?}: {done:?}");
            assert_eq!(done.roles_replayed().0, 4, "{done:?}");
        }
    }
    let [in_process, lockstep] = ["in-process", "lockstep"].map(|clock| bench.path(clock).join("run.mcap"));
    bench.run(&["diff", in_process.to_str().unwrap(), lockstep.to_str().unwrap()]).succeeded();
    let recording = Recording::open(&in_process).unwrap();
    assert_eq!((recording.signals().len(), recording.damage()), (6, None));
    assert_eq!((recording.info().seed, recording.info().whole), (1, true));
    let track = recording.tracks(|info| info.signal == "estimate").unwrap().swap_remove(0);
    assert_eq!(track.ticks(), (0..=1000).collect::<Vec<_>>());
    assert_eq!(track.column("omega_rad_s", 0).unwrap()[0], 0.6);
    assert!(track.column("omega_rad_s", 3).is_none());
    bench.run(&["export", in_process.to_str().unwrap(), "--csv", "tables"]).succeeded();
    let table = std::fs::read_to_string(bench.path("tables/leader.estimate.csv")).unwrap();
    let row: Vec<&str> = table.lines().nth(501).unwrap().split(',').collect();
    let value: f64 = row[8].parse().unwrap();
    assert_eq!((row[2], value.to_bits()), ("500", track.column("omega_rad_s", 2).unwrap()[500].to_bits()));
}

#[test]
fn runs_with_faults_and_killed_roles_are_replayed_exactly() {
    let bench = Bench::new();
    for role in ["leader", "follower", "observer", "controller"] {
        let fault = format!("fault=[{{kind=\"kill\",role=\"{role}\",from_tick=400}}]");
        // In real time the successor has seconds to start, and a delayed recorder reports lost samples.
        for (clock, duration) in [("in-process", "1"), ("lockstep", "1"), ("realtime", "5")] {
            let out = format!("{role}-{clock}");
            let options = ["--clock", clock, "--duration", duration, "--set", &fault];
            let (done, file) = record(&bench, "rigid-pair", &out, &options);
            let complete = bench.summary_in(&out)["recording"]["complete"].as_bool().unwrap();
            assert!(complete || clock == "realtime", "{out}: {done:?}");
            assert_eq!(done.code, Some(i32::from(!complete)), "{out}: {done:?}");
            let whole: &[&str] = if complete { &["--json"] } else { &["--json", "--accept-incomplete"] };
            let replayed = replay(&bench, &file, whole).succeeded().json();
            let roles = replayed["roles"].as_array().unwrap();
            let replay_of = |name: &str| roles.iter().find(|replay| replay["role"] == name).unwrap();
            assert!(roles.iter().all(|replay| replay["same"] == true), "{out}: {replayed}");
            assert!(!complete || roles.iter().all(|replay| replay["limit"].is_null()), "{out}: {replayed}");
            assert!(!complete || replay_of(role)["lives"] == 2, "{out}: {replayed}");
        }
    }
    let long = ["--duration", "14"];
    for (scenario, clock, duration) in [
        ("faults", "in-process", long),
        ("faults", "lockstep", long),
        ("rigid-fleet", "lockstep", ["--duration", "0.2"]),
    ] {
        let out = format!("{scenario}-{clock}");
        let (done, file) = record(&bench, scenario, &out, &[&["--clock", clock], &duration[..]].concat());
        assert_eq!(done.code, Some(0), "{done:?}");
        for options in [&[][..], &["--processes"]] {
            let replayed = replay(&bench, &file, &[options, &["--json"]].concat()).succeeded().json();
            let roles = replayed["roles"].as_array().unwrap();
            assert!(roles.iter().all(|role| role["limit"].is_null()), "{clock} {options:?}: {replayed}");
        }
    }
}

#[test]
fn a_changed_bit_is_found_and_a_different_layout_is_refused() {
    let bench = Bench::new();
    let (done, file) = record(&bench, "rigid-pair", "out", &["--clock", "lockstep", "--duration", "1"]);
    assert_eq!(done.code, Some(0), "{done:?}");
    let changed = bench.path("changed.mcap");
    // The last bit of the estimate's third component: after the CDR header, the stamp and two components.
    let flip = |at: usize, topic: &'static str, tick: u32| {
        rewrite(
            &file,
            &changed,
            |schema| schema,
            move |name, sequence, data| {
                if name == topic && sequence == tick {
                    data[at] ^= 1;
                }
            },
        );
    };
    flip(4 + 32 + 16, "/corotate/rigid_pair/leader/estimate", 700);
    for options in [&["--role", "observer"][..], &["--role", "observer", "--processes"], &[]] {
        let difference = replay_difference(&bench, &changed, options);
        assert_eq!(difference["tick"], 700, "{difference}");
        assert_eq!(difference["service"], "corotate/rigid-pair/leader/estimate", "{difference}");
        assert_eq!(difference["field"], "omega_rad_s[2]", "{difference}");
        assert!(difference["recorded"] != difference["replayed"], "{difference}");
        let done = replay(&bench, &changed, options);
        for word in ["700", "omega_rad_s[2]"].into_iter().chain(["recorded", "replayed"]) {
            assert!(done.code == Some(3) && done.stdout.contains(word), "{word}: {done:?}");
        }
    }
    let done = bench.run(&["diff", file.to_str().unwrap(), changed.to_str().unwrap(), "--json"]);
    let diff = done.json();
    let differing = diff["signals"].as_array().unwrap().iter().filter(|signal| signal["same"] == false);
    let firsts: Vec<_> = differing.map(|signal| (&signal["signal"], &signal["first"])).collect();
    assert!(done.code == Some(3) && firsts.len() == 1 && *firsts[0].0 == "leader/estimate", "{diff}");
    assert!(firsts[0].1["tick"] == 700 && firsts[0].1["field"] == "omega_rad_s[2]", "{diff}");
    let tolerant = ["diff", file.to_str().unwrap(), changed.to_str().unwrap(), "--relative", "1e-12"];
    assert_eq!(bench.run(&tolerant).code, Some(0));
    // A changed input changes the observer's output from that tick on.
    flip(4 + 32, "/corotate/rigid_pair/leader/measurement", 500);
    assert_eq!(replay_difference(&bench, &changed, &["--role", "observer"])["tick"], 500);
    // The last sample is compared too.
    flip(4 + 32, "/corotate/rigid_pair/follower/command", 1000);
    assert_eq!(replay_difference(&bench, &changed, &["--role", "controller"])["tick"], 1000);
    rewrite(
        &file,
        &changed,
        |schema| schema.replace("estimate/v2", "estimate/v1").replace("closure", "sum"),
        |_, _, _| {},
    );
    let done = replay(&bench, &changed, &[]);
    assert!(done.code == Some(2) && done.says("other-layout"), "{done:?}");
    for word in ["corotate/rigid-body/estimate/v1", "sum,", "corotate/rigid-body/estimate/v2", "closure,"] {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
}

#[test]
fn a_truncated_file_is_read_in_part_and_an_oversized_schema_is_refused() {
    let bench = Bench::new();
    let (done, file) = record(&bench, "rigid-pair", "out", &["--clock", "in-process", "--duration", "2"]);
    assert_eq!(done.code, Some(0), "{done:?}");
    let bytes = std::fs::read(&file).unwrap();
    let cut = bench.path("cut.mcap");
    let mut replayed = 0;
    for part in 0..12 {
        std::fs::write(&cut, &bytes[..bytes.len() * part / 12]).unwrap();
        let done = replay(&bench, &cut, &["--accept-incomplete"]);
        let readable = done.code == Some(0) && done.says("incomplete-recording");
        assert!(readable || (done.code == Some(2) && done.says("not-a-recording")), "{part}: {done:?}");
        replayed += u32::from(readable);
    }
    assert!(replayed >= 8, "{replayed}");
    // A sample of this length, or a table with as many columns, would exhaust the memory.
    let long = |schema: String| schema.replace("float64[3] ", "float64[1000000000000] ");
    rewrite(&file, &cut, long, |_, _, _| {});
    let done = bench.run(&["export", cut.to_str().unwrap(), "--csv", "tables"]);
    assert!(done.code == Some(1) && done.says("damaged-recording"), "{done:?}");
}

/// A limit on file sizes acts like a full disk, and any user can set it.
#[test]
fn at_a_file_size_limit_the_recording_stays_readable_and_the_loop_continues() {
    let bench = Bench::new();
    for clock in ["in-process", "lockstep"] {
        let program = bench.command().get_program().to_owned();
        let script = format!(
            "ulimit -f 4000; exec {} run {} --record --out {clock} --clock {clock} --duration 20 --set 'accept={{}}'",
            program.to_str().unwrap(),
            shipped("rigid-pair").display()
        );
        let done = bench.start_program(Path::new("bash"), &["-c", &script]).wait();
        assert_eq!(done.code, Some(1), "{done:?}");
        assert!(done.says("incomplete-recording") && done.stderr.contains("run.mcap"), "{done:?}");
        let summary = bench.summary_in(clock);
        assert_eq!(summary["score"]["scored_ticks"], 20_001);
        assert_eq!(summary["recording"]["complete"], false);
        let signal = &summary["recording"]["signals"][0];
        assert_eq!(signal["published"], 20_001);
        assert_eq!(signal["gaps"][0][1], 20_000, "{signal}");
        let file = bench.path(clock).join("run.mcap");
        assert!(Recording::open(&file).unwrap().signals()[0].samples > 1000);
        assert_eq!(replay(&bench, &file, &[]).code, Some(1));
        assert_eq!(replay(&bench, &file, &["--accept-incomplete"]).code, Some(0));
    }
}

/// Needs a user that may mount a file system. The file has its index, because space for it was reserved.
#[test]
fn on_a_full_disk_the_recording_is_completed_with_an_index() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("small")).unwrap();
    let program = bench.command().get_program().to_owned();
    let script = format!(
        "mount -t tmpfs -o size=700k tmpfs small || exit 77; {} run {} --record --out small --clock lockstep --duration 6 \
         --set 'accept={{}}'; code=$?; cp small/run.mcap kept.mcap; exit $code",
        program.to_str().unwrap(),
        shipped("rigid-pair").display()
    );
    let options = ["--user", "--map-root-user", "--mount", "bash", "-c", &script];
    let done = bench.start_program(Path::new("unshare"), &options).wait();
    if done.code == Some(77) || done.stderr.contains("unshare failed") {
        return skipped("a recording on a full disk", "this user may not mount a file system");
    }
    // ENOSPC.
    let error = "(os error 28)";
    assert!(done.code == Some(1) && done.says("incomplete-recording") && done.stderr.contains(error), "{done:?}");
    let recording = Recording::open(&bench.path("kept.mcap")).unwrap();
    assert_eq!(recording.damage(), None);
    let end = recording.info().end.as_ref().unwrap();
    assert!(!end.complete && end.problem.contains(error), "{}", end.problem);
    assert!(mcap::Summary::read(&std::fs::read(bench.path("kept.mcap")).unwrap()).unwrap().is_some());
    let done = replay(&bench, &bench.path("kept.mcap"), &["--accept-incomplete"]);
    assert!(done.code == Some(0) && done.stderr.contains(error), "{done:?}");
}

/// A recorder that ends within a tick has some of a role's samples of it, and lacks others.
#[test]
fn samples_after_an_early_end_of_the_recording_are_not_differences() {
    let bench = Bench::new();
    let (done, file) = record(&bench, "rigid-pair", "out", &["--clock", "lockstep", "--duration", "1"]);
    assert_eq!(done.code, Some(0), "{done:?}");
    let (cut, ended) = (bench.path("cut.mcap"), bench.path("ended.mcap"));
    let truth = |name: &str, tick: u32, data: &mut Vec<u8>| {
        if name == "/corotate/rigid_pair/leader/truth" && tick == 1000 {
            data.clear();
        }
    };
    rewrite(&file, &cut, |schema| schema, truth);
    assert_eq!(replay(&bench, &cut, &[]).code, Some(3), "the file is marked complete");
    rewrite_metadata(&cut, &ended, |name, entries| {
        if name == "corotate.end" {
            entries.insert("complete".to_owned(), "false".to_owned());
            entries.insert("problem".to_owned(), "the disk is full".to_owned());
        }
    });
    let replayed = replay(&bench, &ended, &["--accept-incomplete", "--json"]).succeeded().json();
    let roles = replayed["roles"].as_array().unwrap();
    assert!(roles.iter().any(|role| role["limit"]["tick"] == 1000), "{replayed}");
}

#[test]
fn a_killed_or_stopped_recorder_does_not_delay_the_run_and_leaves_a_readable_file() {
    let bench = Bench::new();
    for (clock, signal, ticks) in
        [("realtime", SIGKILL, 8000), ("lockstep", SIGKILL, 60_000), ("lockstep", SIGSTOP, 60_000)]
    {
        let out = format!("{clock}-{signal}");
        let (duration, scenario) = ((ticks / 1000).to_string(), shipped("rigid-pair"));
        let timeout = "supervision.heartbeat_timeout_s=0.5";
        let fixed =
            ["run", scenario.to_str().unwrap(), "--record", "--out", &out, "--set", "accept={}", "--set", timeout];
        let running = bench.start(&[&fixed[..], &["--clock", clock, "--duration", &duration]].concat());
        let domain = bench.await_domain();
        let file = bench.path(&out).join("run.mcap");
        // The recorder has written samples.
        await_some(|| std::fs::metadata(&file).ok().filter(|file| file.len() > 100_000));
        let recorder = bench.await_role("record");
        send_signal(recorder, signal);
        let done = running.wait();
        assert_eq!(done.code, Some(1), "{out}: {done:?}");
        assert!(done.says("companion-lost"), "{out}: {done:?}");
        let summary = bench.summary_in(&out);
        let scored = &summary["score"];
        assert_eq!(scored["scored_ticks"].as_u64().unwrap() + scored["unscored_ticks"].as_u64().unwrap(), ticks + 1);
        assert_eq!(summary["recording"]["complete"], false);
        let done = replay(&bench, &file, &["--accept-incomplete"]);
        assert!(done.code == Some(0) && done.says("incomplete-recording"), "{out}: {done:?}");
        assert!(Recording::open(&file).unwrap().signals()[0].samples > 100, "{out}");
        bench.assert_clean(&[domain]);
    }
}

/// Like on a busy disk. A role would be given up after 5 s.
#[test]
fn a_recorder_that_ends_slowly_is_waited_for() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--record", "--clock", "realtime", "--duration", "2", "--out", "out"];
    let patient = ["--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=60"];
    let running = bench.start(&[&words[..], &patient].concat());
    let domain = bench.await_domain();
    let (leader, recorder) = (bench.await_role("leader"), bench.await_role("record"));
    bench.await_ticks("controller");
    send_signal(recorder, SIGSTOP);
    await_some(|| (!std::path::Path::new(&format!("/proc/{leader}")).exists()).then_some(()));
    std::thread::sleep(std::time::Duration::from_secs(7));
    send_signal(recorder, SIGCONT);
    let done = running.wait();
    // Samples sent while it was stopped are lost and reported; the others are in the file, which has its end.
    let recording = &bench.summary_in("out")["recording"];
    assert!(recording["messages"].as_u64().unwrap() > 0, "{recording}: {done:?}");
    assert!(recording["bytes"].as_u64().unwrap() > 0, "{recording}: {done:?}");
    bench.assert_clean(&[domain]);
}

/// No sample is sent until the launcher gives credit, and the launcher must not wait for the recorder to take one.
#[test]
fn a_recorder_that_joins_while_the_loop_waits_for_credit_does_not_block_it() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "20", "--set", "accept={}", "--out", "out"];
    let running = bench.start(&words);
    let domain = bench.await_domain();
    bench.await_ticks("controller");
    running.signal(SIGSTOP);
    let mut commits = u64::MAX;
    await_some(|| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        let before = std::mem::replace(&mut commits, bench.commits("leader"));
        (before == commits).then_some(())
    });
    let recorder = bench.start(&["record", "--domain", domain.to_str().unwrap(), "--out", "part.mcap"]);
    // The recorder opens all signals before the file, and publishes its first heartbeat right after.
    await_some(|| std::fs::metadata(bench.path("part.mcap")).ok());
    std::thread::sleep(std::time::Duration::from_millis(200));
    running.signal(SIGCONT);
    let done = running.wait();
    assert!(done.code == Some(0) && recorder.wait().code == Some(0), "{done:?}");
    bench.assert_clean(&[domain]);
}

/// Returns the size of a run's shared memory: the files that begin with its domain's name.
fn shared_bytes(domain: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let name = format!("corotate_{}_", domain.file_name().unwrap().to_str().unwrap());
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&name));
    ours.filter_map(|file| Some(file.metadata().ok()?.blocks() * 512)).sum()
}

#[test]
fn a_recorder_that_joins_late_takes_all_later_samples_within_four_mebibytes() {
    let bench = Bench::new();
    for (clock, seconds) in [("realtime", "6"), ("lockstep", "60")] {
        let scenario = shipped("rigid-pair");
        let fixed = ["run", scenario.to_str().unwrap(), "--out", clock, "--set", "accept={}", "--clock", clock];
        let running = bench.start(&[&fixed[..], &["--duration", seconds]].concat());
        let domain = bench.await_domain();
        // Waits for a tick with a watcher, which ends before the recorder starts. The watcher lowers the priority of its
        // thread, and the recorder must not inherit that.
        let watch = || {
            await_some(|| {
                let mut session = Session::open(Some(&domain), || false).ok()?;
                session.follow(200_000_000, || false).ok()?;
                (session.model.tick > 0).then_some(())
            })
        };
        std::thread::scope(|scope| scope.spawn(watch).join().unwrap());
        let file = format!("{clock}.mcap");
        let recorder = bench.start(&["record", "--domain", domain.to_str().unwrap(), "--out", &file]);
        await_some(|| std::fs::metadata(bench.path(&file)).ok().filter(|file| file.len() > 0));
        if clock == "realtime" {
            let shared = shared_bytes(&domain);
            assert!(shared > 0 && shared <= 4 << 20, "{shared} bytes");
        }
        let (done, recorded) = (running.wait(), recorder.wait());
        assert_eq!(done.code, Some(0), "{done:?}");
        assert!(!recorded.stdout.is_empty(), "{recorded:?}");
        let recording = Recording::open(&bench.path(&file)).unwrap();
        let end = recording.info().end.as_ref().unwrap();
        assert!(!recording.info().whole && !end.complete && recorded.code == Some(0), "{recorded:?}");
        let track = recording.tracks(|info| info.signal == "truth").unwrap().swap_remove(0);
        let ticks = track.ticks();
        if clock == "lockstep" {
            assert!(ticks.windows(2).all(|pair| pair[0] + 1 == pair[1]), "lockstep loses nothing");
        }
        assert!(ticks.last().is_some_and(|tick| *tick == recording.info().last_tick), "{:?}", ticks.last());
        let replayed = replay(&bench, &bench.path(&file), &["--accept-incomplete", "--json"]).succeeded().json();
        let roles = replayed["roles"].as_array().unwrap();
        assert!(roles.iter().all(|role| role["limit"]["tick"] == 0), "{replayed}");
        bench.assert_clean(&[domain]);
    }
}

/// Reproducible random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ z >> 31) % end
    }

    /// Returns true with the probability 1 / `count`.
    fn one_in(&mut self, count: u64) -> bool {
        self.below(count) == 0
    }

    /// Returns the ticks that a role pauses. Once in `long` calls it may exceed the depth of the links in a replay.
    fn pause(&mut self, long: u64) -> u64 {
        let end = if self.one_in(long) { 300 } else { 8 };
        self.below(end)
    }
}

/// A recorded run in real time with real nodes in one thread, scheduled by the test.
///
/// All ticks are due from the start, so no node waits, and nothing depends on the machine.
struct Scheduled<'a> {
    scenario: &'a Scenario,
    bus: &'a MemoryBus,
    roles: Vec<RoleId>,
    ledgers: Vec<Ledger>,
    _memory: tempfile::TempDir,
    nodes: Vec<Option<ReadyNode>>,
    grid: Grid,
    recorder: Recorder,
}

impl<'a> Scheduled<'a> {
    fn new(scenario: &'a Scenario, bus: &'a MemoryBus, file: &Path) -> Self {
        let length_ns = (scenario.last_tick + 1) * scenario.period_ns;
        let grid = Grid { epoch_ns: monotonic_ns() - length_ns, period_ns: scenario.period_ns };
        let mut recorder = Recorder::open(scenario, bus, file).unwrap();
        recorder.start(grid.epoch_ns, None).unwrap();
        let roles = RoleId::all(scenario);
        let memory = tempfile::tempdir().unwrap();
        let ledger = |role: &RoleId| shared_ledger(scenario, *role, &memory.path().join(role.name(scenario))).unwrap();
        let ledgers = roles.iter().map(ledger).collect();
        let nodes = roles.iter().map(|_| None).collect();
        let mut run = Self { scenario, bus, roles, ledgers, _memory: memory, nodes, grid, recorder };
        (0..run.roles.len()).for_each(|index| run.begin(index, 0));
        run
    }

    /// Starts a role, or its successor, which executes no tick before this one.
    fn begin(&mut self, index: usize, first_tick: u64) {
        let (scenario, role, bus, ledger) = (self.scenario, self.roles[index], self.bus, &self.ledgers[index]);
        let mut node = build(scenario, role, bus, ledger).unwrap();
        node.restore().unwrap();
        let first_tick = first_tick.max(node.next_tick());
        node.start(self.grid, first_tick).unwrap();
        self.nodes[index] = Some(node);
    }

    /// Drops a role without finishing it.
    fn kill(&mut self, index: usize) {
        self.nodes[index] = None;
    }

    /// Polls a role at a tick. Returns true if it executed, without finishing the tick.
    fn poll(&mut self, index: usize, tick: u64, overdue: bool) -> bool {
        let condition = match (self.roles[index], overdue) {
            (RoleId::Plant(_), _) => RunCondition::Now { tick, now_ns: self.grid.due_ns(tick) },
            (_, true) => RunCondition::Overdue,
            (_, false) => RunCondition::Arrived,
        };
        let Some(node) = &mut self.nodes[index] else { return false };
        if node.next_tick() > tick {
            return false;
        }
        node.poll(condition).unwrap() == Poll::Executed
    }

    fn finish_tick(&mut self, index: usize) {
        if let Some(node) = &mut self.nodes[index] {
            node.finish_tick().unwrap();
        }
    }

    /// Polls a role, and finishes the tick if it executed.
    fn execute(&mut self, index: usize, tick: u64) {
        if self.poll(index, tick, false) {
            self.finish_tick(index);
        }
    }

    /// Records the samples that have arrived.
    fn record(&mut self) {
        self.recorder.poll().unwrap();
    }

    fn finish(mut self) {
        self.nodes.iter_mut().flatten().for_each(|node| node.finish().unwrap());
        self.record();
        let role_report = |(role, ledger)| report(self.scenario, role, ledger, Vec::new(), Vec::new());
        let reports: Vec<_> = self.roles.into_iter().zip(&self.ledgers).map(role_report).collect();
        let report = self.recorder.finish(&reports, None);
        assert!(report.complete, "{report:?}");
    }
}

/// Replays every role of a recording in this thread.
fn replays(file: &Path) -> Vec<RoleReplay> {
    let recording = Recording::open(file).unwrap();
    let scenario = recording.scenario_for_replay().unwrap();
    RoleId::all(&scenario).into_iter().map(|role| replay_in_process(&recording, &scenario, role).unwrap()).collect()
}

fn scenario_in_real_time(name: &str, ticks: u64, overrides: &[&str]) -> Scenario {
    let fixed = ["clock=realtime".to_owned(), format!("duration_s={:?}", ticks as f64 / 1e3), "accept={}".to_owned()];
    let overrides: Vec<String> = fixed.into_iter().chain(overrides.iter().map(|text| (*text).to_owned())).collect();
    Scenario::load(&shipped(name), &overrides).unwrap()
}

/// Runs as on a busy machine: polls roles rarely and in random order, pauses and kills them.
fn run_at_random(scenario: &Scenario, file: &Path, random: &mut Random, deaths: bool) {
    let bus = MemoryBus::new(depths(scenario));
    let mut run = Scheduled::new(scenario, &bus, file);
    let mut held_until = vec![0; run.roles.len()];
    for tick in 0..=scenario.last_tick {
        for (index, held) in held_until.iter_mut().enumerate() {
            if run.nodes[index].is_none() && *held <= tick {
                run.begin(index, tick);
            }
            if random.one_in(60) {
                *held = tick + random.pause(4);
            }
        }
        for _ in 0..3 * run.roles.len() {
            let index = random.below(run.roles.len() as u64) as usize;
            let overdue = random.one_in(2);
            if held_until[index] > tick || !run.poll(index, tick, overdue) {
                continue;
            }
            let dies = deaths && random.one_in(150);
            if !dies || random.one_in(2) {
                run.finish_tick(index);
            }
            if dies {
                run.kill(index);
                held_until[index] = tick + 1 + random.pause(2);
            }
        }
        run.record();
    }
    run.finish();
}

#[test]
fn runs_under_any_load_are_replayed_without_difference() {
    let bench = Bench::new();
    let file = bench.path("run.mcap");
    let faults = "fault=[{kind=\"noise-burst\",role=\"leader\",deviation=0.3,from_tick=200,ticks=50,probability=0.5},\
                  {kind=\"drop\",role=\"observer\",from_tick=300,ticks=50,probability=0.5},\
                  {kind=\"delay\",role=\"controller\",delay_ticks=3,from_tick=400,ticks=50},\
                  {kind=\"bit-flip\",role=\"follower\",from_tick=500,ticks=50}]";
    for (name, overrides, limited) in
        [("rigid-pair", &[][..], false), ("rigid-trio", &[], true), ("rigid-pair", &[faults], true)]
    {
        let scenario = scenario_in_real_time(name, 1000, overrides);
        let mut complete = 0;
        for seed in 0..30 {
            run_at_random(&scenario, &file, &mut Random(seed), seed % 2 == 1);
            for replay in replays(&file) {
                println!("{name} {seed} {replay:?}");
                assert_eq!(replay.difference, None, "{name}, seed {seed}: {}, {} lives", replay.role, replay.lives);
                assert!(limited || seed % 2 == 1 || replay.limit.is_none(), "{name}, seed {seed}: {replay:?}");
                complete += u64::from(replay.limit.is_none());
            }
        }
        assert!(complete > 50, "{name}: {complete} of at least 120 replays are complete");
    }
}

/// A withheld sample does not show whether its tick was executed. The final counters do, if the role missed no tick then.
#[test]
fn a_replay_is_limited_where_neither_samples_nor_counters_show_what_was_executed() {
    let bench = Bench::new();
    let file = bench.path("run.mcap");
    let fault = "fault=[{kind=\"drop\",role=\"observer\",from_tick=300,ticks=100}]";
    let scenario = scenario_in_real_time("rigid-pair", 1000, &[fault]);
    for (held, limit) in [(0..0, None), (350..360, Some(300)), (700..710, None)] {
        let bus = MemoryBus::new(depths(&scenario));
        let mut run = Scheduled::new(&scenario, &bus, &file);
        for tick in 0..=scenario.last_tick {
            for index in 0..4 {
                if run.roles[index] != RoleId::Observer(0) || !held.contains(&tick) {
                    run.execute(index, tick);
                }
            }
            run.record();
        }
        run.finish();
        let replays = replays(&file);
        let observer = replays.iter().find(|replay| replay.role == "observer").unwrap();
        let found = observer.limit.as_ref().map(|limit| limit.tick);
        assert_eq!((&observer.difference, found), (&None, limit), "{held:?}: {observer:?}");
    }
}

/// Outages shorter and longer than the depth of the links in a replay.
#[test]
fn an_outage_of_any_length_is_replayed() {
    let bench = Bench::new();
    let file = bench.path("run.mcap");
    let scenario = scenario_in_real_time("rigid-pair", 1000, &[]);
    for victim in 0..4 {
        for outage in [1, 20, 127, 128, 129, 500] {
            let bus = MemoryBus::new(depths(&scenario));
            let mut run = Scheduled::new(&scenario, &bus, &file);
            for tick in 0..=scenario.last_tick {
                match tick.checked_sub(400) {
                    Some(0) => run.kill(victim),
                    Some(ticks) if ticks == outage => run.begin(victim, tick),
                    _ => {}
                }
                (0..4).for_each(|index| run.execute(index, tick));
                run.record();
            }
            run.finish();
            for replay in replays(&file) {
                let description = format!("{victim} {outage} {replay:?}");
                assert_eq!((replay.difference, replay.limit), (None, None), "{description}");
            }
        }
    }
}
