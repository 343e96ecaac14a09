//! Recordings as Parquet, read by an independent library and compared with the recordings and the CSV.

use crate::common::{Bench, Done, python, rewrite, root, shipped};
use corotate::record::{Recording, Track};
use corotate::sample::FieldKind;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Values whose bits are easily lost: NaNs with payload, infinities, both zeros, the smallest and the largest number.
const HARD: [u64; 9] = [
    0x7ff8_dead_beef_0001,
    0xfff0_0000_0000_0001,
    0x7ff0_0000_0000_0000,
    0xfff0_0000_0000_0000,
    0,
    1 << 63,
    1,
    0x7fef_ffff_ffff_ffff,
    u64::MAX,
];

/// Runs a shipped scenario and returns its recording.
fn record(bench: &Bench, scenario: &str, options: &[&str]) -> PathBuf {
    let file = shipped(scenario);
    let fixed = ["run", file.to_str().unwrap(), "--record", "--out", scenario, "--overwrite", "--set", "accept={}"];
    bench.run(&[&fixed, options].concat()).succeeded();
    bench.path(scenario).join("run.mcap")
}

fn export(bench: &Bench, file: &Path, options: &[&str]) -> Done {
    bench.run(&[&["export", file.to_str().unwrap()], options].concat()).succeeded()
}

/// A table: names and types of the columns, and their bits.
type Table = (Vec<(String, FieldKind)>, Vec<Vec<u64>>);

/// Returns the expected table of a recorded signal.
fn recorded(recording: &Recording, track: &Track) -> Table {
    let mut columns = vec![("time_s".to_owned(), FieldKind::F64), ("received_ns".to_owned(), FieldKind::U64)];
    let fields = track.info.layout.columns.iter();
    columns.extend(fields.flat_map(|field| field.elements().map(|name| (name, field.kind))));
    let time = |index| track.stamp(index).tick as f64 * (recording.info().period_ns as f64 / 1e9);
    let mut bits = vec![(0..track.len()).map(|index| time(index).to_bits()).collect(), track.received_ns.clone()];
    let word = |index, at: usize| u64::from_le_bytes(track.sample(index)[8 * at..][..8].try_into().unwrap());
    bits.extend((0..columns.len() - 2).map(|at| (0..track.len()).map(|index| word(index, at)).collect()));
    (columns, bits)
}

/// Returns a table and its metadata as the independent reader found them.
fn read(path: &Path) -> (Table, Value) {
    let about: Value = serde_json::from_slice(&std::fs::read(path.with_extension("json")).unwrap()).unwrap();
    let kind = |name: &str| if name == "uint64" { FieldKind::U64 } else { FieldKind::F64 };
    let column = |column: &Value| (column[0].as_str().unwrap().to_owned(), kind(column[1].as_str().unwrap()));
    let columns: Vec<_> = about["columns"].as_array().unwrap().iter().map(column).collect();
    let rows: u64 = about["groups"].as_array().unwrap().iter().map(|rows| rows.as_u64().unwrap()).sum();
    let bytes = std::fs::read(path.with_extension("words")).unwrap();
    let words: Vec<u64> = bytes.chunks_exact(8).map(|word| u64::from_le_bytes(word.try_into().unwrap())).collect();
    assert_eq!(words.len(), columns.len() * rows as usize);
    let bits = (0..columns.len()).map(|at| words[at * rows as usize..][..rows as usize].to_vec()).collect();
    ((columns, bits), about)
}

/// Asserts that the Parquet files of a directory equal the recording. Returns the metadata of each.
fn assert_as_recorded(bench: &Bench, tables: &str, file: &Path) -> Vec<Value> {
    let program = root().join("tests/readers/parquet.py");
    bench.start_program(&python("readers"), &[program.to_str().unwrap(), tables]).wait().succeeded();
    let recording = Recording::open(file).unwrap();
    let tracks = recording.tracks(|_| true).unwrap();
    assert!(tracks.len() >= 5, "{}", tracks.len());
    let check = |track: &Track| {
        let info = &track.info;
        let path = bench.path(tables).join(format!("{}.{}.parquet", info.body, info.signal));
        let (table, about) = read(&path);
        assert!(table == recorded(&recording, track), "{}", info.service);
        let metadata = &about["metadata"];
        assert_eq!(metadata["corotate.service"], *info.service);
        assert_eq!(metadata["corotate.scenario_hash"], *recording.info().scenario_hash);
        about
    };
    tracks.iter().map(check).collect()
}

/// Asserts that a table has the same values in CSV, where NaNs have no payload.
fn assert_same_csv(path: &Path) {
    let ((columns, bits), _) = read(path);
    let text = std::fs::read_to_string(path.with_extension("csv")).unwrap();
    let mut lines = text.lines();
    assert!(lines.next().unwrap().split(',').eq(columns.iter().map(|(name, _)| name)), "{}", path.display());
    let mut rows = 0;
    for line in lines {
        for (at, word) in line.split(',').enumerate() {
            let expected = bits[at][rows];
            let same = match columns[at].1 {
                FieldKind::U64 => word.parse() == Ok(expected),
                FieldKind::F64 if f64::from_bits(expected).is_nan() => word == "NaN",
                FieldKind::F64 => word.parse().map(f64::to_bits) == Ok(expected),
            };
            assert!(same, "{}: row {rows}, {}: {word}", path.display(), columns[at].0);
        }
        rows += 1;
    }
    assert_eq!(rows, bits[0].len());
}

/// Asserts that both formats were written and equal the recording.
fn assert_exported(bench: &Bench, tables: &str, done: &Done, file: &Path) {
    let groups = assert_as_recorded(bench, tables, file);
    assert!(groups.iter().all(|about| about["groups"].as_array().unwrap().len() <= 1));
    let files: Vec<&Path> = done.stdout.lines().map(Path::new).collect();
    let parquet: Vec<_> = files.iter().filter(|file| file.extension().unwrap() == "parquet").collect();
    assert_eq!((files.len(), parquet.len()), (2 * groups.len(), groups.len()), "{files:?}");
    parquet.iter().for_each(|file| assert_same_csv(&bench.path("").join(file)));
    let left = std::fs::read_dir(bench.path(tables)).unwrap();
    assert_eq!(left.count(), 4 * groups.len(), "only the tables and the reader's output");
}

#[test]
fn an_independent_reader_finds_every_bit_of_every_signal() {
    let bench = Bench::new();
    for (scenario, clock) in [("rigid-pair", "lockstep"), ("orbit-rendezvous", "in-process")] {
        let file = record(&bench, scenario, &["--clock", clock, "--duration", "1"]);
        let tables = format!("{scenario}.tables");
        let done = export(&bench, &file, &["--csv", &tables, "--parquet", &tables]);
        assert_eq!(done.stderr, "");
        assert_exported(&bench, &tables, &done, &file);
    }
}

#[test]
fn nan_payloads_are_kept_and_a_truncated_file_is_exported_in_part() {
    let bench = Bench::new();
    let file = record(&bench, "rigid-pair", &["--clock", "in-process", "--duration", "2"]);
    let changed = bench.path("changed.mcap");
    let harden = |_: &str, sequence: u32, data: &mut Vec<u8>| {
        for (at, word) in data[4..].chunks_exact_mut(8).enumerate() {
            word.copy_from_slice(&HARD[(at + sequence as usize) % HARD.len()].to_le_bytes());
        }
    };
    rewrite(&file, &changed, |schema| schema, harden);
    let done = export(&bench, &changed, &["--parquet", "hard", "--csv", "hard"]);
    assert_exported(&bench, "hard", &done, &changed);
    let bytes = std::fs::read(&file).unwrap();
    let cut = bench.path("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let done = export(&bench, &cut, &["--parquet", "cut", "--csv", "cut", "--accept-incomplete"]);
    assert!(done.says("incomplete-recording"), "{done:?}");
    assert_exported(&bench, "cut", &done, &cut);
    let samples = |file| Recording::open(file).unwrap().signals()[0].samples;
    assert!((1..samples(&file)).contains(&samples(&cut)));
}

#[test]
fn a_long_recording_is_written_in_groups() {
    let bench = Bench::new();
    let file = record(&bench, "rigid-pair", &["--clock", "in-process", "--duration", "120"]);
    export(&bench, &file, &["--parquet", "tables"]);
    for about in assert_as_recorded(&bench, "tables", &file) {
        let groups: Vec<u64> = about["groups"].as_array().unwrap().iter().map(|rows| rows.as_u64().unwrap()).collect();
        assert!(groups.len() > 1 && groups[1..].iter().all(|rows| *rows <= groups[0]), "{groups:?}");
    }
}

#[test]
fn tables_that_cannot_be_written_leave_nothing_behind() {
    let bench = Bench::new();
    let file = record(&bench, "rigid-pair", &["--clock", "in-process", "--duration", "2"]);
    let program = bench.command().get_program().to_str().unwrap().to_owned();
    for form in ["parquet", "csv"] {
        let script = format!("ulimit -f 20; exec {program} export {} --{form} {form}", file.display());
        let done = bench.start_program(Path::new("bash"), &["-c", &script]).wait();
        assert!(done.code == Some(1) && done.stderr.contains("(os error 27)"), "{done:?}");
        assert_eq!(std::fs::read_dir(bench.path(form)).unwrap().count(), 0);
    }
}

#[test]
fn a_fleet_with_too_many_columns_is_refused() {
    let bench = Bench::new();
    let options = ["--clock", "in-process", "--duration", "0.01", "--set", "follower.0.count=6000"];
    let file = record(&bench, "rigid-fleet", &options);
    let done = bench.run(&["export", file.to_str().unwrap(), "--parquet", "tables"]);
    assert!(done.code == Some(2) && done.says("too-many-columns"), "{done:?}");
    assert!(!bench.path("tables").exists());
}
