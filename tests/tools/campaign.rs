//! `corotate sweep`: interrupted, killed, split into shards, and compared with an exact solution.

use crate::common::{self, Bench, Done, await_some, root};
use corotate::campaign::{Campaign, End, Entry, Row, SweepError, Table};
use corotate::config::{ClockKind, ConfigError};
use libc::{SIGINT, SIGKILL};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicUsize;

/// Ten gains times two decay rates of the observer; short, so that a debug build is quick.
const MAP: &str = r#"
name = "map"
base = "rigid-pair"

[set]
duration_s = 1.0
accept = { settled_by_s = 0.8, sync_error_rad_s_max = 0.3, estimate_error_rad_s_max = 1.0 }

[[axis]]
key = "controller.gain_per_s"
range = { from = 1.0, to = 20.0, points = 10, log = true }

[[axis]]
key = "observer.decay_rate_per_s"
values = [6.0, 12.0]

[[margin]]
find = "smallest"
key = "controller.gain_per_s"
from = 0.1
to = 20.0
tolerance = 0.5
"#;

fn bench(campaign: &str) -> Bench {
    let bench = Bench::new();
    fs::write(bench.path("map.toml"), campaign).unwrap();
    bench
}

fn sweep(bench: &Bench, arguments: &[&str]) -> Done {
    bench.run(&[&["sweep", "map.toml"], arguments].concat()).succeeded()
}

/// Reads the result files, which are equal for equal campaigns.
fn results(directory: &Path) -> Vec<(&'static str, Vec<u8>)> {
    let names = ["campaign.toml", "cases.csv", "summary.json"].into_iter();
    let names = names.chain(cfg!(feature = "parquet").then_some("cases.parquet"));
    names.map(|name| (name, fs::read(directory.join(name)).unwrap())).collect()
}

/// Returns the words of stdout without punctuation.
fn words(done: &Done) -> Vec<&str> {
    done.stdout.split_whitespace().map(|word| word.trim_matches([',', ';', ':'])).collect()
}

fn assert_same(bench: &Bench, directory: &str, reference: &str) {
    for ((name, found), (_, expected)) in
        results(&bench.path(directory)).into_iter().zip(results(&bench.path(reference)))
    {
        assert!(found == expected, "{directory}/{name} differs from {reference}");
    }
}

#[test]
fn the_table_does_not_depend_on_the_number_of_threads() {
    let bench = bench(MAP);
    let done = sweep(&bench, &["--out", "one", "--threads", "1"]);
    assert!(["20", "2"].iter().all(|count| words(&done).contains(count)), "{done:?}");
    assert!(["smallest", "controller.gain_per_s"].iter().all(|word| words(&done).contains(word)), "{done:?}");
    sweep(&bench, &["--out", "two", "--threads", "3", "-q"]);
    assert_same(&bench, "two", "one");
    let table = Table::read(&bench.path("one")).unwrap();
    assert_eq!((table.rows.len() as u64, table.cases, table.margins[0].points.len()), (20, 20, 2));
    assert!(table.rows.iter().all(|row| row.exit == End::Completed && row.executed == 4 * 1001));
    let accepted = |row: &&Row| row.accepted == Some(true);
    for point in &table.margins[0].points {
        let [holds, not] = point.bracket.map(Option::unwrap);
        assert!(point.parameters[0].is_none() && (holds - not).abs() <= 0.5);
        let decay = point.parameters[1].as_ref().unwrap();
        let same_decay = table.rows.iter().filter(|row| row.parameters[1] == *decay);
        let lowest =
            same_decay.filter(accepted).map(|row| row.parameters[0].number().unwrap()).reduce(f64::min).unwrap();
        assert!(not <= lowest && lowest <= 1.4 * holds + 0.5, "{lowest}: {point:?}");
        // The printed table has one digit more than the tolerance.
        let row = done.stdout.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        let row = row.into_iter().find(|row| row.len() == 3 && row[0] == decay.to_string()).expect("its row");
        let digits = |value: f64| if value.fract() == 0.0 { value.to_string() } else { format!("{value:.2}") };
        assert_eq!(row[1..], [digits(holds), digits(not)], "{done:?}");
    }
    // A finished campaign is not run again.
    let journal = || fs::read(bench.path("one/journal")).unwrap();
    let finished = journal();
    sweep(&bench, &["--out", "one"]);
    assert!(journal() == finished, "cases were run again");
    assert_same(&bench, "one", "two");
}

/// As with Python's executors: pieces run anywhere, and their entries are collected.
#[test]
fn collected_entries_make_the_same_table() {
    let bench = bench(MAP);
    sweep(&bench, &["--out", "whole", "-q"]);
    let unknown = |name: &str| Err(ConfigError::Unknown { code: "unknown-scenario", text: name.to_owned() });
    let campaign = Campaign::load(&bench.path("whole/campaign.toml"), &[], &unknown).unwrap();
    let no_signal = AtomicUsize::new(0);
    let work = |piece| campaign.work(piece, ClockKind::InProcess, &no_signal).unwrap();
    let entries: Vec<String> =
        (0..campaign.pieces()).rev().map(|piece| serde_json::to_string(&work(piece)).unwrap()).collect();
    let parsed = || entries.iter().map(|entry| serde_json::from_str::<Entry>(entry).unwrap());
    assert!(campaign.work(campaign.pieces(), ClockKind::InProcess, &no_signal).is_none());
    let mut collection = campaign.clone().collect(&bench.path("made")).unwrap();
    parsed().skip(1).for_each(|entry| collection.add(&entry).unwrap());
    assert_eq!(collection.left(), [campaign.pieces() - 1]);
    assert!(collection.finish().is_err(), "an entry is missing");
    parsed().for_each(|entry| collection.add(&entry).unwrap());
    let swept = collection.finish().unwrap();
    assert_eq!((swept.done, swept.counts.unwrap().rows), (22, 20));
    assert_same(&bench, "made", "whole");
    let mut disagreeing = work(3);
    if let Entry::Row(row) = &mut disagreeing {
        row.hash = "0".repeat(16);
    }
    let error = collection.add(&disagreeing).unwrap_err();
    assert!(matches!(error, SweepError::Disagree { case: 3, .. }), "{error}");
}

#[test]
fn merged_shards_equal_the_whole_campaign() {
    let bench = bench(MAP);
    sweep(&bench, &["--out", "whole", "-q"]);
    for index in 0..3 {
        sweep(&bench, &["--out", &format!("part-{index}"), "--shard", &format!("{index}/3"), "-q"]);
    }
    let missing = bench.run(&["sweep", "merge", "part-0", "part-2", "--out", "few"]);
    assert_eq!(missing.code, Some(2), "{missing:?}");
    assert!(missing.says("missing-cases"), "{missing:?}");
    bench.run(&["sweep", "merge", "part-2", "part-0", "part-1", "--out", "merged"]).succeeded();
    assert_same(&bench, "merged", "whole");
    let shard = bench.run(&["sweep", "map.toml", "--out", "part-0", "--shard", "1/3"]);
    assert!(shard.code == Some(2) && shard.says("other-campaign"), "{shard:?}");
}

/// Kills the program three times, leaves half a line in the journal, and starts it again.
#[test]
fn a_killed_campaign_resumes_with_the_same_table() {
    let bench = bench(&MAP.replace("points = 10", "points = 60"));
    sweep(&bench, &["--out", "whole", "-q"]);
    let journal = bench.path("killed/journal");
    let count = |path: &Path| fs::read(path).unwrap_or_default().iter().filter(|byte| **byte == b'\n').count();
    let lines = || count(&journal);
    let mut done = 1;
    for _ in 0..3 {
        let running = bench.start(&["sweep", "map.toml", "--out", "killed", "--threads", "1"]);
        await_some(|| (lines() > done + 5).then_some(()));
        running.signal(SIGKILL);
        assert_eq!(running.wait().signal, Some(SIGKILL));
        done = lines();
        assert!(done < 120, "the campaign ended before it was killed: {done}");
        let mut torn = fs::read(&journal).unwrap();
        torn.extend(b"0123456789abcdef {\"row\":{\"case\":");
        fs::write(&journal, torn).unwrap();
    }
    let finished = fs::read(&journal).unwrap();
    let finished = &finished[..=finished.iter().rposition(|byte| *byte == b'\n').unwrap()];
    sweep(&bench, &["--out", "killed"]);
    assert!(fs::read(&journal).unwrap().starts_with(finished), "finished cases were dropped");
    assert_eq!(lines(), count(&bench.path("whole/journal")), "each case runs once");
    assert_same(&bench, "killed", "whole");
}

#[test]
fn an_interrupted_campaign_resumes() {
    let bench = bench(&MAP.replace("points = 10", "points = 200"));
    let running = bench.start(&["sweep", "map.toml", "--threads", "1"]);
    let runs = bench.path("runs");
    let journal = || fs::read_dir(&runs).ok()?.next()?.ok().map(|entry| entry.path().join("journal"));
    await_some(|| fs::read(journal()?).ok().filter(|bytes| bytes.iter().filter(|byte| **byte == b'\n').count() > 3));
    running.signal(SIGINT);
    let done = running.wait();
    assert_eq!(done.code, Some(130), "{done:?}");
    assert!(done.says("interrupted"), "{done:?}");
    let directory = journal().unwrap();
    let directory = directory.parent().unwrap();
    assert!(!directory.join("cases.csv").exists());
    let rows = Table::read(directory).unwrap().rows.len();
    assert!((2..400).contains(&rows), "{rows}");
    // Finds the newest directory of this campaign, and none of another.
    let done = bench.run(&["sweep", "map.toml", "--resume", "--json"]).succeeded();
    let summary = done.json();
    assert_eq!((&summary["counts"]["rows"], &summary["cases"]), (&400.into(), &400.into()));
    assert_eq!(
        summary["directory"].as_str().map(|path| bench.path(path)),
        Some(bench.path("runs").join(directory.file_name().unwrap()))
    );
    let changed = bench.run(&["sweep", "map.toml", "--set", "tick_hz=500", "--resume"]);
    assert!(changed.code == Some(2) && changed.says("nothing-to-resume"), "{changed:?}");
}

#[test]
fn a_case_is_reproduced_under_other_clocks() {
    let bench = bench(MAP);
    sweep(&bench, &["--out", "map", "-q"]);
    let table = Table::read(&bench.path("map")).unwrap();
    for (file, case, clock) in
        [("map.toml", 17, "in-process"), ("map.toml", 4, "lockstep"), ("map/campaign.toml", 11, "lockstep")]
    {
        let case_number = case.to_string();
        let done = bench.run(&[
            "run",
            file,
            "--case",
            &case_number,
            "--clock",
            clock,
            "--json",
            "--out",
            "run",
            "--overwrite",
        ]);
        assert!(matches!(done.code, Some(0 | 3)), "{done:?}");
        let summary = done.json();
        let row = &table.rows[case];
        assert_eq!(summary["state"]["hash"].as_str(), Some(&*row.hash), "case {case}");
        assert_eq!(summary["accepted"].as_bool(), row.accepted);
        assert_eq!(summary["score"]["metrics"][0]["ise"].as_f64(), row.metrics[3]);
    }
    // In lockstep, cases have the same rows as in one thread.
    let few = MAP.replace("points = 10", "points = 2");
    fs::write(bench.path("map.toml"), &few[..few.find("[[margin]]").unwrap()]).unwrap();
    sweep(&bench, &["--out", "thread", "-q"]);
    sweep(&bench, &["--out", "lockstep", "--clock", "lockstep", "--threads", "1", "-q"]);
    assert_same(&bench, "lockstep", "thread");
    let none = bench.run(&["run", "map.toml", "--case", "4"]);
    assert!(none.code == Some(2) && none.says("no-such-case"), "{none:?}");
    let unnamed = bench.run(&["run", "map.toml"]);
    assert!(unnamed.code == Some(2) && unnamed.says("is-campaign"), "{unnamed:?}");
}

/// An invalid case, and one that leaves the range of its model, are rows.
#[test]
fn a_failed_case_is_a_row_and_does_not_end_the_campaign() {
    let campaign = r#"
name = "map"
base = "orbit-rendezvous"
[set]
duration_s = 6.0
accept = {}
[[axis]]
key = "follower.0.initial_radius_du"
values = [-1.0, 9.9, 1.2]
[[axis]]
key = "follower.0.initial_velocity_du_s"
values = [[2.0, 0.0]]
"#;
    let bench = bench(campaign);
    let counts = sweep(&bench, &["--out", "map", "--json"]).json()["counts"].clone();
    assert_eq!((&counts["not_accepted"], &counts["not_judged"]), (&1.into(), &2.into()), "{counts}");
    assert_eq!((&counts["exits"]["lost"], &counts["exits"]["invalid"]), (&1.into(), &1.into()), "{counts}");
    let rows = Table::read(&bench.path("map")).unwrap().rows;
    assert_eq!(rows[0].exit, End::Invalid);
    assert!(
        rows[0].reason.as_ref().unwrap().starts_with("map.toml:8: follower[0].initial_radius_du: -1"),
        "{:?}",
        rows[0]
    );
    assert!(rows[0].hash.is_empty() && rows[0].accepted.is_none());
    assert_eq!((rows[1].exit, rows[1].accepted), (End::Lost, Some(false)), "{:?}", rows[1]);
    assert!(rows[1].lost > 0 && rows[1].metrics[2].is_none(), "{:?}", rows[1]);
    let csv = fs::read_to_string(bench.path("map/cases.csv")).unwrap();
    let first: Vec<&str> = csv.lines().next().unwrap().split(',').collect();
    assert_eq!(first[..4], ["case", "seed", "follower.0.initial_radius_du", "follower.0.initial_velocity_du_s"]);
}

#[test]
fn a_directory_with_other_contents_is_refused() {
    let bench = bench(MAP);
    fs::create_dir(bench.path("full")).unwrap();
    fs::write(bench.path("full/letter.txt"), "dear").unwrap();
    let done = bench.run(&["sweep", "map.toml", "--out", "full"]);
    assert!(done.code == Some(2) && done.says("not-a-campaign"), "{done:?}");
    assert_eq!(fs::read_dir(bench.path("full")).unwrap().count(), 1);
    sweep(&bench, &["--out", "map", "-q"]);
    let changed = bench.run(&["sweep", "map.toml", "--set", "seed=5", "--out", "map"]);
    assert!(changed.code == Some(2) && changed.says("other-campaign"), "{changed:?}");
    let merged = bench.run(&["sweep", "merge", "full", "--out", "merged"]);
    assert!(merged.code == Some(1) && merged.says("cannot-read"), "{merged:?}");
    // An unknown key is reported before any case runs.
    fs::write(bench.path("map.toml"), MAP.replace("gain_per_s", "gain")).unwrap();
    let unknown = bench.run(&["sweep", "map.toml", "--out", "new"]);
    assert!(unknown.code == Some(2) && unknown.says("unknown-key"), "{unknown:?}");
    assert!(["map.toml:10:", "controller.gain:"].iter().all(|place| unknown.stderr.contains(place)), "{unknown:?}");
    assert!(!bench.path("new").exists());
}

#[test]
fn record_repeats_the_worst_cases() {
    let bench = bench(MAP);
    let done = sweep(&bench, &["--out", "map", "--record", "2"]);
    let table = Table::read(&bench.path("map")).unwrap();
    let error = |case: u64| table.rows[case as usize].metrics[1].unwrap();
    let recorded: Vec<u64> =
        (0..table.cases).filter(|case| bench.path(&format!("map/case-{case}/run.mcap")).exists()).collect();
    assert_eq!(recorded.len(), 2);
    for case in &recorded {
        let directory = format!("map/case-{case}");
        assert!(done.stderr.lines().any(|line| line.ends_with(&directory)), "{directory}: {done:?}");
    }
    let best = recorded.iter().map(|case| error(*case)).fold(f64::INFINITY, f64::min);
    assert!((0..table.cases).filter(|case| !recorded.contains(case)).all(|case| error(case) <= best));
    let summary = fs::read(bench.path(&format!("map/case-{}/summary.json", recorded[0]))).unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
    assert_eq!(summary["state"]["hash"].as_str(), Some(&*table.rows[recorded[0] as usize].hash));
}

#[test]
fn shipped_campaigns_are_found_by_name() {
    let bench = Bench::new();
    let list = bench.run(&["init", "--list"]);
    for name in ["timing-map", "inertia-error", "noise-filter", "start"] {
        assert!(list.stdout.contains(&format!("{name} ")), "{list:?}");
        bench.run(&["init", name]).succeeded();
        let checked = bench.run(&["check", name, "--json"]);
        let campaign = checked.json();
        assert!(campaign["campaign"] == name && campaign["cases"].as_u64() > Some(60), "{campaign}");
    }
    let run = bench.run(&["run", "timing-map"]);
    assert!(run.code == Some(2) && run.says("is-campaign"), "{run:?}");
    let sweep = bench.run(&["sweep", "rigid-pair"]);
    assert!(sweep.code == Some(2) && sweep.says("is-scenario"), "{sweep:?}");
    let misspelt = bench.run(&["sweep", "timing-mop"]);
    assert!(misspelt.says("unknown-campaign") && misspelt.stderr.contains("`timing-map`"), "{misspelt:?}");
}

/// With a leader at rest and a slow follower, products of rates vanish: the loop is an integrator under a proportional law that
/// acts one tick late, p(k+1) = p(k) − h g p(k−1). Its solution and the integral of its square are known exactly.
#[test]
fn a_linear_case_has_the_cost_of_the_exact_solution() {
    let campaign = r#"
name = "map"
base = "rigid-pair"
[set]
duration_s = 2.0
accept = {}
leader.initial_rate_rad_s = [0.0, 0.0, 0.0]
follower = [{ name = "follower", initial_rate_rad_s = [2e-4, -3e-4, 1e-4] }]
[[axis]]
key = "controller.gain_per_s"
values = [0.5, 4.0, 40.0, 150.0, 240.0, 300.0, 700.0]
"#;
    let bench = bench(campaign);
    sweep(&bench, &["--out", "map", "-q"]);
    let table = Table::read(&bench.path("map")).unwrap();
    let column = table.metrics.iter().position(|metric| metric.name == "sync_error_rad_s.ise").unwrap();
    let (h, ticks, start) = (1e-3, 2001, 2e-4_f64.hypot(3e-4).hypot(1e-4));
    for row in &table.rows {
        let gain = row.parameters[0].number().unwrap();
        let (found, exact) = (row.metrics[column].unwrap(), h * start * start * squares(h * gain, ticks));
        println!("gain {gain}: {found:e}, exactly {exact:e}: {:+.1e}", found / exact - 1.0);
        assert!((found / exact - 1.0).abs() < 1e-2, "gain {gain}: {found:e} is not {exact:e}");
    }
}

/// Returns the sum of the first `terms` squares of the solution of x(k+1) = x(k) − c x(k−1) with x(0) = x(1) = 1, as geometric series
/// of the roots of r² − r + c, which may be complex.
fn squares(c: f64, terms: i32) -> f64 {
    type Complex = (f64, f64);
    let times = |a: Complex, b: Complex| (a.0 * b.0 - a.1 * b.1, a.0 * b.1 + a.1 * b.0);
    let over = |a: Complex, b: Complex| {
        let size = b.0 * b.0 + b.1 * b.1;
        let product = times(a, (b.0, -b.1));
        (product.0 / size, product.1 / size)
    };
    let root = if c < 0.25 { ((0.25 - c).sqrt(), 0.0) } else { (0.0, (c - 0.25).sqrt()) };
    let (r, s): (Complex, Complex) = ((0.5 + root.0, root.1), (0.5 - root.0, -root.1));
    // x(k) = a r^k + b s^k, with a + b = 1 and a r + b s = 1.
    let a = over((1.0 - s.0, -s.1), (r.0 - s.0, r.1 - s.1));
    let b = (1.0 - a.0, -a.1);
    let power = |base: Complex| (0..terms).fold((1.0, 0.0), |power, _| times(power, base));
    let series = |base: Complex| {
        let end = power(base);
        over((1.0 - end.0, -end.1), (1.0 - base.0, -base.1))
    };
    let part = |factor: Complex, base: Complex| times(factor, series(base)).0;
    part(times(a, a), times(r, r)) + 2.0 * part(times(a, b), times(r, s)) + part(times(b, b), times(s, s))
}

/// Runs the script for a Slurm array with local processes instead of nodes.
#[test]
fn the_slurm_script_runs_and_merges_shards() {
    let bench = bench(MAP);
    sweep(&bench, &["--out", "whole", "-q"]);
    let programs = bench.path("programs");
    fs::create_dir(&programs).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_corotate"), programs.join("corotate")).unwrap();
    let script = root().join("docs/slurm-array.sh");
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    let task = |index: u32| {
        let mut command: Command = bench.command_of("bash".as_ref());
        command.arg(&script).args(["map.toml", "results", "3"]).env("PATH", &path);
        command.env("SLURM_ARRAY_TASK_ID", index.to_string()).env("SLURM_CPUS_PER_TASK", "1");
        common::Running::new(&mut command)
    };
    let tasks: Vec<_> = (0..3).map(task).collect();
    for task in tasks {
        task.wait().succeeded();
    }
    let mut merge = bench.command_of("bash".as_ref());
    merge.arg(&script).args(["merge", "results"]).env("PATH", &path);
    common::Running::new(&mut merge).wait().succeeded();
    assert_same(&bench, "results/whole", "whole");
}
