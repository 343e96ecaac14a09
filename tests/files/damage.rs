//! Damaged recordings: a reader returns what was recorded, or refuses the file; text in a file cannot control a terminal.
//!
//! The suite tries a part of all damages; `COROTATE_DAMAGE=all cargo test --release --test all damage::` tries all.

use crate::common::{Bench, Done, rewrite_metadata};
use corotate::config::SHIPPED;
use corotate::launch::{Launch, run};
use corotate::record::Recording;
use corotate::scenario::Scenario;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicUsize;
use xxhash_rust::xxh3::Xxh3;

/// Records a run of `rigid-pair` in this thread.
fn record(bench: &Bench, name: &str, duration_s: &str) -> PathBuf {
    let overrides = ["clock=in-process".to_owned(), format!("duration_s={duration_s}"), "accept={}".to_owned()];
    let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &overrides).unwrap();
    let file = bench.path(name);
    run(&scenario, &mut Launch { record: Some(file.clone()), ..Launch::new(&AtomicUsize::new(0), &mut |_| {}) })
        .unwrap();
    file
}

/// Returns a hash of everything that is read from a recording; `None` if it is refused.
fn content_hash(file: &Path) -> Option<u64> {
    let recording = Recording::open(file).ok()?;
    recording.require_whole().ok()?;
    let mut hasher = Xxh3::new();
    hasher.update(format!("{:?} {:?}", recording.info(), recording.signals()).as_bytes());
    let each = |signal: usize, received_ns: u64, sample: &[u8]| {
        hasher.update(&signal.to_le_bytes());
        hasher.update(&received_ns.to_le_bytes());
        hasher.update(sample);
    };
    recording.visit(each).ok()?;
    Some(hasher.digest())
}

/// Returns true if every damage is tried instead of a part.
fn try_all() -> bool {
    std::env::var("COROTATE_DAMAGE").is_ok_and(|which| which == "all")
}

fn open(file: &Path) -> File {
    OpenOptions::new().read(true).write(true).open(file).unwrap()
}

/// Returns the end of the data section, which has the chunks and metadata.
fn data_end(bytes: &[u8]) -> usize {
    let mut at = 8;
    while bytes[at] != mcap::records::op::DATA_END {
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    at
}

/// Returns the ranges of compressed samples. All other bytes are headers, metadata and indexes.
fn compressed_ranges(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (mut at, end, mut found) = (8, data_end(bytes), Vec::new());
    while at < end {
        let next = at + 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        if bytes[at] == mcap::records::op::CHUNK {
            // 40 bytes of header and the 3 of `lz4` come first.
            found.push(at + 9 + 40 + 3..next);
        }
        at = next;
    }
    found
}

#[test]
fn any_changed_bit_of_a_small_recording_is_detected_or_harmless() {
    let bench = Bench::new();
    let path = record(&bench, "small.mcap", "0.01");
    let bytes = std::fs::read(&path).unwrap();
    let (intact, compressed) = (content_hash(&path).unwrap(), compressed_ranges(&bytes));
    assert!(!compressed.is_empty());
    let file = open(&path);
    let (mut tried, mut harmless) = (0, 0);
    for at in (0..bytes.len()).step_by(if try_all() { 1 } else { 5 }) {
        let content = compressed.iter().any(|range| range.contains(&at));
        for bit in (0..8).filter(|bit| !content || *bit == at % 8) {
            file.write_all_at(&[bytes[at] ^ (1 << bit)], at as u64).unwrap();
            let found = content_hash(&path);
            assert!(found.is_none_or(|found| found == intact), "byte {at}, bit {bit}");
            (tried, harmless) = (tried + 1, harmless + usize::from(found.is_some()));
        }
        file.write_all_at(&[bytes[at]], at as u64).unwrap();
    }
    assert_eq!(content_hash(&path), Some(intact));
    println!("{tried} damages of {} bytes, {harmless} harmless", bytes.len());
    assert!(harmless * 20 < tried, "too few bits are under a checksum: {harmless} of {tried} are harmless");
}

/// Reproducible random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % end.max(1)
    }
}

/// Returns the bytes with one random damage, of the kinds that disks, transfers and editors cause.
fn damage(random: &mut Random, bytes: &[u8]) -> Vec<u8> {
    let (at, length) = (random.below(bytes.len()), 1 + random.below(4096));
    let end = (at + length).min(bytes.len());
    let mut damaged = bytes.to_vec();
    match random.below(6) {
        0 => damaged[at] = random.below(256) as u8,
        1 => (0..8).for_each(|_| damaged[random.below(bytes.len())] ^= 1 << random.below(8)),
        2 => damaged[at..end].fill(0),
        3 => damaged.truncate(at),
        4 => drop(damaged.drain(at..end)),
        _ => {
            let from = random.below(bytes.len() - (end - at));
            damaged.copy_within(from..from + (end - at), at);
        }
    }
    damaged
}

#[test]
fn random_damage_of_a_large_recording_is_detected_or_harmless() {
    let bench = Bench::new();
    let path = record(&bench, "large.mcap", if try_all() { "20" } else { "5" });
    let bytes = std::fs::read(&path).unwrap();
    assert!(compressed_ranges(&bytes).len() > 5);
    let intact = content_hash(&path).unwrap();
    let (random, damaged) = (&mut Random(1), bench.path("damaged.mcap"));
    let (mut tried, mut harmless) = (0, 0);
    while tried < if try_all() { 5000 } else { 250 } {
        let changed = damage(random, &bytes);
        if changed == bytes {
            continue;
        }
        std::fs::write(&damaged, &changed).unwrap();
        let found = content_hash(&damaged);
        assert!(found.is_none_or(|found| found == intact), "damage {tried}");
        (tried, harmless) = (tried + 1, harmless + usize::from(found.is_some()));
    }
    println!("{tried} damages of {} bytes, {harmless} harmless", bytes.len());
    assert!(harmless * 20 < tried, "{harmless} of {tried}");
}

/// Runs every command that reads recordings. `diff` compares the file with itself.
fn run_readers(bench: &Bench, file: &Path, flags: &[&str]) -> Vec<Done> {
    let file = file.to_str().unwrap();
    let _ = std::fs::remove_dir_all(bench.path("tables"));
    [&["export", file, "--csv", "tables"][..], &["replay", file], &["diff", file, file]]
        .iter()
        .map(|command| bench.run(&[command, flags].concat()))
        .collect()
}

#[test]
fn every_command_refuses_a_damaged_file_and_reads_a_part_only_on_request() {
    let bench = Bench::new();
    let path = record(&bench, "run.mcap", "2");
    let bytes = std::fs::read(&path).unwrap();
    let chunk = compressed_ranges(&bytes)[2].clone();
    let wrong = bench.path("wrong.mcap");
    let flip_bit = |at: usize| {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        std::fs::write(&wrong, &changed).unwrap();
    };
    flip_bit((chunk.start + chunk.end) / 2);
    for done in run_readers(&bench, &wrong, &[]) {
        assert!(done.code == Some(1) && done.says("damaged-recording"), "{done:?}");
        assert!(done.stdout.is_empty() && !bench.path("tables").exists(), "{done:?}");
    }
    for done in run_readers(&bench, &wrong, &["--accept-incomplete"]) {
        assert!(done.code == Some(1) && done.says("damaged-recording"), "{done:?}");
        assert!(!done.stdout.is_empty(), "{done:?}");
    }
    let rows = |file: &Path| {
        let done = bench.run(&["export", file.to_str().unwrap(), "--csv", "rows", "--accept-incomplete"]);
        (done.code, std::fs::read_to_string(bench.path("rows/leader.truth.csv")).unwrap())
    };
    let ((_, part), (code, full)) = (rows(&wrong), rows(&path));
    assert!(code == Some(0) && full.starts_with(&part) && part.lines().count() > 100, "{} rows", part.lines().count());
    let page = |file: &Path| bench.run(&["report", file.to_str().unwrap(), "--out", "page.html"]);
    let done = page(&wrong);
    assert!(done.code == Some(1) && done.stderr.contains("damaged") && bench.path("page.html").exists(), "{done:?}");
    // Damaged metadata: a digit of the period, and a letter of the scenario.
    for (text, digit) in [("period_ns", 13), ("decay_rate", 0)] {
        let at = bytes.windows(text.len()).position(|window| window == text.as_bytes());
        flip_bit(at.map_or_else(|| panic!("{text} is missing"), |at| at + digit));
        for done in run_readers(&bench, &wrong, &["--accept-incomplete"]).into_iter().chain([page(&wrong)]) {
            let refused = done.says("damaged-recording") && done.stderr.contains("`corotate.run`");
            assert!(done.code == Some(1) && refused, "{text}: {done:?}");
        }
    }
    std::fs::write(&wrong, &bytes[..chunk.end + 100]).unwrap();
    for done in run_readers(&bench, &wrong, &[]) {
        assert!(done.code == Some(1) && done.stdout.is_empty(), "{done:?}");
        assert!(done.says("incomplete-recording") && done.stderr.contains(" of 2000"), "{done:?}");
        assert!(done.stderr.contains("--accept-incomplete"), "{done:?}");
    }
    for done in run_readers(&bench, &wrong, &["--accept-incomplete"]) {
        assert!(done.code == Some(0) && done.says("incomplete-recording"), "{done:?}");
    }
    let done = page(&wrong);
    assert!(done.code == Some(0) && done.stderr.contains(" of 2000"), "{done:?}");
}

/// The changed files have correct checksums, as a deliberate forgery has.
#[test]
fn text_in_a_recording_cannot_control_a_terminal_or_a_page() {
    let bench = Bench::new();
    let (path, wrong) = (record(&bench, "run.mcap", "0.1"), bench.path("wrong.mcap"));
    let hostile = "\u{1b}]0;owned\u{7}\u{9b}2J\u{202e}<script>alert(1)</script>";
    rewrite_metadata(&path, &wrong, |name, entries| {
        if name == "corotate.end" {
            entries.insert("complete".to_owned(), "false".to_owned());
            entries.insert("problem".to_owned(), hostile.to_owned());
        }
    });
    let report = bench.run(&["report", wrong.to_str().unwrap(), "--out", "page.html"]);
    for flags in [&[][..], &["--accept-incomplete"]] {
        for done in run_readers(&bench, &wrong, flags).iter().chain([&report]) {
            let text = format!("{}{}", done.stdout, done.stderr);
            assert!(text.contains("owned") && text.contains("\\u{1b}"), "{done:?}");
            assert!(!text.contains(['\u{1b}', '\u{7}', '\u{9b}', '\u{202e}']), "{done:?}");
        }
    }
    let page = std::fs::read_to_string(bench.path("page.html")).unwrap();
    assert!(page.contains("owned") && page.matches("<script").count() == 1, "the page has only its own script");
    assert!(!page.contains(['\u{1b}', '\u{7}', '\u{9b}']));
    // A scenario that does not match its hash.
    rewrite_metadata(&path, &wrong, |_, entries| {
        entries.entry("scenario".to_owned()).and_modify(|text| *text = text.replace("seed = 1", "seed = 2"));
    });
    for done in run_readers(&bench, &wrong, &["--accept-incomplete"]) {
        assert!(done.code == Some(1) && done.says("damaged-recording"), "{done:?}");
    }
}

#[test]
fn a_wrong_length_in_a_file_does_not_allocate_memory() {
    let bench = Bench::new();
    let path = record(&bench, "run.mcap", "2");
    let bytes = std::fs::read(&path).unwrap();
    let (wrong, chunk) = (bench.path("wrong.mcap"), compressed_ranges(&bytes)[1].clone());
    let program = bench.command().get_program().to_owned();
    let script = format!("ulimit -v 400000; exec {} export wrong.mcap --csv tables", program.to_str().unwrap());
    let mut files: Vec<Vec<u8>> = (1..12).map(|part| bytes[..bytes.len() * part / 12].to_vec()).collect();
    // The length of a chunk's record, its uncompressed size, and its compressed size.
    for field in [-53_isize + 1, -53 + 9 + 16, -53 + 9 + 36] {
        let mut changed = bytes.clone();
        let at = chunk.start.checked_add_signed(field).unwrap();
        changed[at..at + 8].copy_from_slice(&(1_u64 << 34).to_le_bytes());
        files.push(changed);
    }
    for (number, content) in files.iter().enumerate() {
        std::fs::write(&wrong, content).unwrap();
        let done = bench.start_program(Path::new("bash"), &["-c", &script]).wait();
        assert_eq!(done.code, Some(1), "{number}: {done:?}");
    }
}
