//! Recordings: what is in them beside what was published, read by programs that share no code with ours; replayed; cut off.

use crate::common::{Bench, Done, await_some, python, rewrite, rewrite_metadata, root, send_signal, shipped, skipped};
use corotate::bus::Reader;
use corotate::bus::memory::MemoryBus;
use corotate::clock::{Grid, monotonic_ns};
use corotate::record::{Recorder, Recording, RoleReplay, replay_in_process};
use corotate::runtime::{
    Poll, ReadyNode, RoleId, RunCondition, depths, drive_in_turn, ports, private_ledger, report, shared_ledger,
};
use corotate::sample::topic_of;
use corotate::scenario::Scenario;
use corotate::scenario::build;
use corotate::telemetry::Ledger;
use corotate::watch::Session;
use libc::{SIGCONT, SIGKILL, SIGSTOP};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Runs a shipped scenario with a recording; gives the run's end and the recording.
fn record(bench: &Bench, scenario: &str, out: &str, arguments: &[&str]) -> (Done, PathBuf) {
    let file = shipped(scenario);
    let common = ["run", file.to_str().unwrap(), "--record", "--overwrite", "--out", out, "--set", "accept={}"];
    (bench.run(&[&common, arguments].concat()), bench.path(out).join("run.mcap"))
}

fn replay(bench: &Bench, file: &Path, options: &[&str]) -> Done {
    bench.run(&[&["replay", file.to_str().unwrap()], options].concat())
}

/// Everything that is published in a run in this thread, byte by byte, by service; no recorder takes part.
fn published(scenario: &Scenario) -> BTreeMap<String, Vec<u8>> {
    let bus = MemoryBus::new(depths(scenario));
    let roles = RoleId::all(scenario);
    let writes = roles.iter().flat_map(|role| ports(scenario, *role).writes);
    let mut taps: Vec<_> =
        writes.map(|port| (port.topic.to_string(), port.reader(&bus, Reader::Scorer).unwrap())).collect();
    let mut all: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    let node = |role: &RoleId| {
        let ledger = private_ledger(scenario, *role);
        build(scenario, *role, &bus, &ledger).unwrap()
    };
    let mut nodes: Vec<_> = roles.iter().map(node).collect();
    let none = |_| panic!("no role dies here");
    let grid = Grid { epoch_ns: 0, period_ns: scenario.period_ns };
    nodes.iter_mut().for_each(|node| node.start(grid, 0).unwrap());
    drive_in_turn(&mut nodes, scenario.last_tick, none, |_| {
        for (service, reader) in &mut taps {
            while let Some(words) = reader.next().unwrap() {
                all.entry(service.clone()).or_default().extend_from_slice(bytemuck::cast_slice(words));
            }
        }
        true
    })
    .unwrap();
    all
}

#[test]
fn foreign_readers_decode_every_field_of_every_sample_as_it_was_published() {
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
        assert_eq!(std::fs::read_dir(&decoded).unwrap().count(), 2 * published.len(), "no signal beside those");
    }
}

#[test]
fn every_clock_is_recorded_completely_and_replayed_to_the_last_bit() {
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
            let done = replay(&bench, &file, options);
            assert_eq!(done.code, Some(0), "{clock} {options:?}: {done:?}");
            assert_eq!(done.stdout.matches("the same to the last bit").count(), 4, "{done:?}");
        }
    }
    let [one, other] = ["in-process", "lockstep"].map(|clock| bench.path(clock).join("run.mcap"));
    bench.run(&["diff", one.to_str().unwrap(), other.to_str().unwrap()]).succeeded();
    let recording = Recording::open(&one).unwrap();
    assert_eq!((recording.signals().len(), recording.damage()), (6, None));
    assert_eq!((recording.info().seed, recording.info().whole), (1, true));
    let track = recording.tracks(|info| info.signal == "estimate").unwrap().swap_remove(0);
    assert_eq!(track.ticks(), (0..=1000).collect::<Vec<_>>());
    assert_eq!(track.column("omega_rad_s", 0).unwrap()[0], 0.6);
    assert!(track.column("omega_rad_s", 3).is_none());
    bench.run(&["export", one.to_str().unwrap(), "--csv", "tables"]).succeeded();
    let table = std::fs::read_to_string(bench.path("tables/leader.estimate.csv")).unwrap();
    let row: Vec<&str> = table.lines().nth(501).unwrap().split(',').collect();
    let value: f64 = row[8].parse().unwrap();
    assert_eq!((row[2], value.to_bits()), ("500", track.column("omega_rad_s", 2).unwrap()[500].to_bits()));
}

#[test]
fn faults_and_deaths_are_replayed_as_they_were() {
    let bench = Bench::new();
    for role in ["leader", "follower", "observer", "controller"] {
        let fault = format!("fault=[{{kind=\"kill\",role=\"{role}\",from_tick=400}}]");
        // In real time the successor has seconds to come, and a recorder that was held up loses samples and says so.
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
            let done = replay(&bench, &file, options);
            assert_eq!(done.code, Some(0), "{clock} {options:?}: {done:?}");
            assert!(!done.stdout.contains("nothing can be"), "{done:?}");
        }
    }
}

#[test]
fn one_bit_is_found_wherever_it_is_and_another_layout_is_refused() {
    let bench = Bench::new();
    let (done, file) = record(&bench, "rigid-pair", "out", &["--clock", "lockstep", "--duration", "1"]);
    assert_eq!(done.code, Some(0), "{done:?}");
    let changed = bench.path("changed.mcap");
    // The last bit of the third component of the estimate: behind the CDR header, the stamp and two components.
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
        let done = replay(&bench, &changed, options);
        assert_eq!(done.code, Some(3), "{done:?}");
        let words = "tick 700, corotate/rigid-pair/leader/estimate omega_rad_s[2]:\n  recorded ";
        assert!(done.stdout.contains(words) && done.stdout.contains("\n  replayed "), "{done:?}");
    }
    let done = bench.run(&["diff", file.to_str().unwrap(), changed.to_str().unwrap()]);
    assert!(done.code == Some(3) && done.stdout.contains("tick 700, leader/estimate omega_rad_s[2]"), "{done:?}");
    let tolerant = ["diff", file.to_str().unwrap(), changed.to_str().unwrap(), "--relative", "1e-12"];
    assert_eq!(bench.run(&tolerant).code, Some(0));
    // An input: what the observer makes of it differs from then on.
    flip(4 + 32, "/corotate/rigid_pair/leader/measurement", 500);
    let done = replay(&bench, &changed, &["--role", "observer"]);
    assert!(done.code == Some(3) && done.stdout.contains("at tick 500, "), "{done:?}");
    // The last sample is compared, too.
    flip(4 + 32, "/corotate/rigid_pair/follower/command", 1000);
    let done = replay(&bench, &changed, &["--role", "controller"]);
    assert!(done.code == Some(3) && done.stdout.contains("tick 1000, "), "{done:?}");
    rewrite(
        &file,
        &changed,
        |schema| schema.replace("estimate/v2", "estimate/v1").replace("closure", "sum"),
        |_, _, _| {},
    );
    let done = replay(&bench, &changed, &[]);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert!(done.stderr.contains("corotate/rigid-body/estimate/v1 (") && done.stderr.contains(" sum, "), "{done:?}");
    assert!(
        done.stderr.contains("corotate/rigid-body/estimate/v2 (") && done.stderr.contains(" closure, "),
        "{done:?}"
    );
}

#[test]
fn a_file_that_was_cut_off_is_read_as_far_as_it_goes_and_no_file_is_believed() {
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
        assert!(readable || (done.code == Some(2) && done.stderr.contains("no recording")), "{part}: {done:?}");
        replayed += u32::from(readable);
    }
    assert!(replayed >= 8, "{replayed}");
    // No sample is so long, and nobody is to make as many columns.
    let long = |schema: String| schema.replace("float64[3] ", "float64[1000000000000] ");
    rewrite(&file, &cut, long, |_, _, _| {});
    let done = bench.run(&["export", cut.to_str().unwrap(), "--csv", "tables"]);
    assert!(done.code == Some(1) && done.stderr.contains("has no samples of ours"), "{done:?}");
}

/// Where files have a limit, which any user can have, as where the disk is full.
#[test]
fn without_room_the_recording_ends_readable_and_the_loop_goes_on() {
    let bench = Bench::new();
    for clock in ["in-process", "lockstep"] {
        let program = bench.command().get_program().to_owned();
        let script = format!(
            "ulimit -f 600; exec {} run {} --record --out {clock} --clock {clock} --duration 6 --set 'accept={{}}'",
            program.to_str().unwrap(),
            shipped("rigid-pair").display()
        );
        let done = bench.start_program(Path::new("bash"), &["-c", &script]).wait();
        assert_eq!(done.code, Some(1), "{done:?}");
        assert!(done.says("incomplete-recording") && done.stderr.contains("run.mcap"), "{done:?}");
        let summary = bench.summary_in(clock);
        assert_eq!(summary["score"]["scored_ticks"], 6001);
        assert_eq!(summary["recording"]["complete"], false);
        let signal = &summary["recording"]["signals"][0];
        assert_eq!(signal["published"], 6001);
        assert_eq!(signal["gaps"][0][1], 6000, "{signal}");
        let file = bench.path(clock).join("run.mcap");
        assert!(Recording::open(&file).unwrap().signals()[0].samples > 1000);
        assert_eq!(replay(&bench, &file, &[]).code, Some(1));
        assert_eq!(replay(&bench, &file, &["--accept-incomplete"]).code, Some(0));
    }
}

/// A disk of its own, where this user may make one: then the file has its index, because room for it was kept.
#[test]
fn on_a_full_disk_the_recording_has_an_end() {
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
        return skipped("a recording on a full disk", "this user may not mount a disk of its own");
    }
    assert!(done.code == Some(1) && done.stderr.contains("the disk is full"), "{done:?}");
    let recording = Recording::open(&bench.path("kept.mcap")).unwrap();
    assert_eq!(recording.damage(), None);
    let end = recording.info().end.as_ref().unwrap();
    assert!(!end.complete && end.problem.contains("the disk is full"), "{}", end.problem);
    assert!(mcap::Summary::read(&std::fs::read(bench.path("kept.mcap")).unwrap()).unwrap().is_some());
    let done = replay(&bench, &bench.path("kept.mcap"), &["--accept-incomplete"]);
    assert!(done.code == Some(0) && done.stderr.contains("the disk is full"), "{done:?}");
}

/// A recorder that ends amid a tick has one of a role's samples and not the other.
#[test]
fn what_a_recording_that_ended_early_has_not_is_no_difference() {
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
    assert_eq!(replay(&bench, &cut, &[]).code, Some(3), "it says that it is complete");
    rewrite_metadata(&cut, &ended, |name, entries| {
        if name == "corotate.end" {
            entries.insert("complete".to_owned(), "false".to_owned());
            entries.insert("problem".to_owned(), "the disk is full".to_owned());
        }
    });
    let done = replay(&bench, &ended, &["--accept-incomplete"]).succeeded();
    assert!(done.stdout.contains("from tick 1000 on nothing can be compared: the recording ended there"), "{done:?}");
}

#[test]
fn a_recorder_that_dies_or_hangs_holds_nobody_up_and_leaves_what_it_had() {
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
        let domain = await_some(|| bench.domains().pop());
        let file = bench.path(&out).join("run.mcap");
        // Under way: there is more than the head of the file.
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

/// As a busy disk keeps it: more than 5 s, in which it would be given up were it a role.
#[test]
fn a_recorder_that_is_long_about_its_end_is_waited_for() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--record", "--clock", "realtime", "--duration", "2", "--out", "out"];
    let patient = ["--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=60"];
    let running = bench.start(&[&words[..], &patient].concat());
    let domain = await_some(|| bench.domains().pop());
    let (leader, recorder) = (bench.await_role("leader"), bench.await_role("record"));
    bench.await_ticks("controller");
    send_signal(recorder, SIGSTOP);
    await_some(|| (!std::path::Path::new(&format!("/proc/{leader}")).exists()).then_some(()));
    std::thread::sleep(std::time::Duration::from_secs(7));
    send_signal(recorder, SIGCONT);
    let done = running.wait();
    // What it could not take while it stood still is lost and told; what it had is in the file, with its end.
    let recording = &bench.summary_in("out")["recording"];
    assert!(recording["messages"].as_u64().unwrap() > 0, "{recording}: {done:?}");
    assert!(recording["bytes"].as_u64().unwrap() > 0, "{recording}: {done:?}");
    bench.assert_clean(&[domain]);
}

/// Nothing is sent to whoever joins then, and the loop must not wait for it to take something.
#[test]
fn a_recorder_that_joins_a_loop_that_waits_for_credit_does_not_stop_it() {
    let bench = Bench::new();
    let words = ["run", "rigid-pair", "--clock", "lockstep", "--duration", "20", "--set", "accept={}", "--out", "out"];
    let running = bench.start(&words);
    let domain = await_some(|| bench.domains().pop());
    bench.await_ticks("controller");
    running.signal(SIGSTOP);
    let mut commits = u64::MAX;
    await_some(|| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        let before = std::mem::replace(&mut commits, bench.commits("leader"));
        (before == commits).then_some(())
    });
    let recorder = bench.start(&["record", "--domain", domain.to_str().unwrap(), "--out", "part.mcap"]);
    // Every signal is open before there is a file; its first word follows at once.
    await_some(|| std::fs::metadata(bench.path("part.mcap")).ok());
    std::thread::sleep(std::time::Duration::from_millis(200));
    running.signal(SIGCONT);
    let done = running.wait();
    assert!(done.code == Some(0) && recorder.wait().code == Some(0), "{done:?}");
    bench.assert_clean(&[domain]);
}

/// All that a run shares lies in files that begin with its domain's name.
fn shared_bytes(domain: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let name = format!("corotate_{}_", domain.file_name().unwrap().to_str().unwrap());
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&name));
    ours.filter_map(|file| Some(file.metadata().ok()?.blocks() * 512)).sum()
}

#[test]
fn a_recorder_beside_a_running_loop_takes_everything_from_then_on_within_four_mebibytes() {
    let bench = Bench::new();
    for (clock, seconds) in [("realtime", "6"), ("lockstep", "60")] {
        let scenario = shipped("rigid-pair");
        let fixed = ["run", scenario.to_str().unwrap(), "--out", clock, "--set", "accept={}", "--clock", clock];
        let running = bench.start(&[&fixed[..], &["--duration", seconds]].concat());
        let domain = await_some(|| bench.domains().pop());
        // The watcher sees a tick; it is gone again before the recorder comes. In a thread of its own: it gives way to
        // everybody, and what is started from its thread would too.
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
        assert!(recorded.stdout.contains("from the midst of the run on"), "{recorded:?}");
        let track = recording.tracks(|info| info.signal == "truth").unwrap().swap_remove(0);
        let ticks = track.ticks();
        if clock == "lockstep" {
            assert!(ticks.windows(2).all(|pair| pair[0] + 1 == pair[1]), "lockstep loses nothing");
        }
        assert!(ticks.last().is_some_and(|tick| *tick == recording.info().last_tick), "{:?}", ticks.last());
        let done = replay(&bench, &bench.path(&file), &["--accept-incomplete"]);
        assert!(done.code == Some(0) && done.stdout.contains("in the midst of the run"), "{done:?}");
        bench.assert_clean(&[domain]);
    }
}

/// Numbers that look random, the same in every run.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ z >> 31) % end
    }

    fn one_in(&mut self, count: u64) -> bool {
        self.below(count) == 0
    }

    /// Ticks that a role stands still; one in so many is longer than links are deep in a replay.
    fn pause(&mut self, long: u64) -> u64 {
        let most = if self.one_in(long) { 300 } else { 8 };
        self.below(most)
    }
}

/// A run in real time whose schedule the test decides: real nodes, recorded, in one thread. All ticks are due already, so no
/// node waits for the time and nothing depends on the machine.
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

    /// A role takes its seat, and executes no tick before this one.
    fn begin(&mut self, index: usize, first_tick: u64) {
        let (scenario, role, bus, ledger) = (self.scenario, self.roles[index], self.bus, &self.ledgers[index]);
        let mut node = build(scenario, role, bus, ledger).unwrap();
        node.restore().unwrap();
        let first_tick = first_tick.max(node.next_tick());
        node.start(self.grid, first_tick).unwrap();
        self.nodes[index] = Some(node);
    }

    /// A role dies without a word.
    fn die(&mut self, index: usize) {
        self.nodes[index] = None;
    }

    /// One look of a role at its inputs, at a tick; whether it executed.
    fn look(&mut self, index: usize, tick: u64, overdue: bool) -> bool {
        let gate = match (self.roles[index], overdue) {
            (RoleId::Plant(_), _) => RunCondition::Now { tick, now_ns: self.grid.due_ns(tick) },
            (_, true) => RunCondition::Overdue,
            (_, false) => RunCondition::Arrived,
        };
        let Some(node) = &mut self.nodes[index] else { return false };
        if node.next_tick() > tick {
            return false;
        }
        node.poll(gate).unwrap() == Poll::Executed
    }

    fn settle(&mut self, index: usize) {
        if let Some(node) = &mut self.nodes[index] {
            node.finish_tick().unwrap();
        }
    }

    /// One look, and what an executed tick leaves to be done.
    fn turn(&mut self, index: usize, tick: u64, overdue: bool) -> bool {
        let executed = self.look(index, tick, overdue);
        if executed {
            self.settle(index);
        }
        executed
    }

    /// The recording takes what has come.
    fn record(&mut self) {
        self.recorder.poll().unwrap();
    }

    fn finish(mut self) {
        self.nodes.iter_mut().flatten().for_each(|node| node.finish().unwrap());
        self.record();
        let of = |(role, ledger)| report(self.scenario, role, ledger, Vec::new(), Vec::new());
        let reports: Vec<_> = self.roles.into_iter().zip(&self.ledgers).map(of).collect();
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

/// A run on a machine that is busy with something else: roles look seldom and in any order, stand still, and die.
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
            if held_until[index] > tick || !run.look(index, tick, overdue) {
                continue;
            }
            let dies = deaths && random.one_in(150);
            if !dies || random.one_in(2) {
                run.settle(index);
            }
            if dies {
                run.die(index);
                held_until[index] = tick + 1 + random.pause(2);
            }
        }
        run.record();
    }
    run.finish();
}

#[test]
fn whatever_a_loaded_machine_made_of_a_run_is_replayed() {
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
        let mut told = 0;
        for seed in 0..30 {
            run_at_random(&scenario, &file, &mut Random(seed), seed % 2 == 1);
            for replay in replays(&file) {
                println!("{name} {seed} {replay:?}");
                assert_eq!(replay.difference, None, "{name}, seed {seed}: {}, {} lives", replay.role, replay.lives);
                assert!(limited || seed % 2 == 1 || replay.limit.is_none(), "{name}, seed {seed}: {replay:?}");
                told += u64::from(replay.limit.is_none());
            }
        }
        assert!(told > 50, "{name}: {told} of 120 and more to their end");
    }
}

/// Samples that a fault keeps back do not tell that they were made; the counters of a role that missed none do.
#[test]
fn what_neither_samples_nor_counters_tell_is_not_claimed() {
    let bench = Bench::new();
    let file = bench.path("run.mcap");
    let fault = "fault=[{kind=\"drop\",role=\"observer\",from_tick=300,ticks=100}]";
    let scenario = scenario_in_real_time("rigid-pair", 1000, &[fault]);
    for (held, limit) in [(0..0, None), (350..360, Some(300)), (700..710, None)] {
        let bus = MemoryBus::new(depths(&scenario));
        let mut run = Scheduled::new(&scenario, &bus, &file);
        for tick in 0..=scenario.last_tick {
            for index in 0..4 {
                if run.roles[index] != RoleId::Observer || !held.contains(&tick) {
                    run.turn(index, tick, false);
                }
            }
            run.record();
        }
        run.finish();
        let replays = replays(&file);
        let observer = replays.iter().find(|replay| replay.role == "observer").unwrap();
        let told = observer.limit.as_ref().map(|limit| limit.tick);
        assert_eq!((&observer.difference, told), (&None, limit), "{held:?}: {observer:?}");
    }
}

/// A controller whose successor is ready after more ticks than links are deep in a replay.
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
                    Some(0) => run.die(victim),
                    Some(dead) if dead == outage => run.begin(victim, tick),
                    _ => {}
                }
                (0..4).for_each(|index| {
                    run.turn(index, tick, false);
                });
                run.record();
            }
            run.finish();
            for replay in replays(&file) {
                let told = format!("{victim} {outage} {replay:?}");
                assert_eq!((replay.difference, replay.limit), (None, None), "{told}");
            }
        }
    }
}
