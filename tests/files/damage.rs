//! Damaged recordings: what is read of one is what was recorded, or it is refused; and what it says commands no terminal.
//!
//! The suite takes a part of all damages; `COROTATE_DAMAGE=all cargo test --release --test all damage::` takes them all.

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

/// Everything that is read of a recording, as one number; none if it is refused.
fn read(file: &Path) -> Option<u64> {
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

/// Whether every damage is tried, or a part of them.
fn all() -> bool {
    std::env::var("COROTATE_DAMAGE").is_ok_and(|which| which == "all")
}

fn open(file: &Path) -> File {
    OpenOptions::new().read(true).write(true).open(file).unwrap()
}

/// The first byte behind the last record that is no summary: chunks and metadata are before it.
fn data_end(bytes: &[u8]) -> usize {
    let mut at = 8;
    while bytes[at] != mcap::records::op::DATA_END {
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    at
}

/// Where the packed samples lie: everything else is heads, metadata, indexes.
fn packed(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (mut at, end, mut found) = (8, data_end(bytes), Vec::new());
    while at < end {
        let next = at + 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        if bytes[at] == mcap::records::op::CHUNK {
            // 40 bytes and the name of the compression are before.
            found.push(at + 9 + 40 + 3..next);
        }
        at = next;
    }
    found
}

#[test]
fn no_bit_of_a_small_recording_can_be_changed_unnoticed() {
    let bench = Bench::new();
    let path = record(&bench, "small.mcap", "0.01");
    let bytes = std::fs::read(&path).unwrap();
    let (whole, packed) = (read(&path).unwrap(), packed(&bytes));
    assert!(!packed.is_empty());
    let file = open(&path);
    let (mut tried, mut same) = (0, 0);
    for at in (0..bytes.len()).step_by(if all() { 1 } else { 5 }) {
        let content = packed.iter().any(|range| range.contains(&at));
        for bit in (0..8).filter(|bit| !content || *bit == at % 8) {
            file.write_all_at(&[bytes[at] ^ (1 << bit)], at as u64).unwrap();
            let found = read(&path);
            assert!(found.is_none_or(|found| found == whole), "byte {at}, bit {bit}");
            (tried, same) = (tried + 1, same + usize::from(found.is_some()));
        }
        file.write_all_at(&[bytes[at]], at as u64).unwrap();
    }
    assert_eq!(read(&path), Some(whole));
    println!("{tried} damages of {} bytes, {same} that change nothing", bytes.len());
    assert!(same * 20 < tried, "almost every bit is under a checksum: {same} of {tried}");
}

/// Numbers of a reproducible kind.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % end.max(1)
    }
}

/// One damage, as disks, transfers and editors do them.
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
fn no_random_damage_of_a_large_recording_goes_unnoticed() {
    let bench = Bench::new();
    let path = record(&bench, "large.mcap", if all() { "20" } else { "5" });
    let bytes = std::fs::read(&path).unwrap();
    assert!(packed(&bytes).len() > 5);
    let whole = read(&path).unwrap();
    let (random, damaged) = (&mut Random(1), bench.path("damaged.mcap"));
    let (mut tried, mut same) = (0, 0);
    while tried < if all() { 5000 } else { 250 } {
        let wrong = damage(random, &bytes);
        if wrong == bytes {
            continue;
        }
        std::fs::write(&damaged, &wrong).unwrap();
        let found = read(&damaged);
        assert!(found.is_none_or(|found| found == whole), "damage {tried}");
        (tried, same) = (tried + 1, same + usize::from(found.is_some()));
    }
    println!("{tried} damages of {} bytes, {same} that change nothing", bytes.len());
    assert!(same * 20 < tried, "{same} of {tried}");
}

/// What every command says and does about a recording; `diff` compares it with itself.
fn commands(bench: &Bench, file: &Path, flags: &[&str]) -> Vec<Done> {
    let file = file.to_str().unwrap();
    let _ = std::fs::remove_dir_all(bench.path("tables"));
    [&["export", file, "--csv", "tables"][..], &["replay", file], &["diff", file, file]]
        .iter()
        .map(|command| bench.run(&[command, flags].concat()))
        .collect()
}

#[test]
fn every_command_refuses_what_is_damaged_and_asks_before_it_goes_on_with_a_part() {
    let bench = Bench::new();
    let path = record(&bench, "run.mcap", "2");
    let bytes = std::fs::read(&path).unwrap();
    let chunk = packed(&bytes)[2].clone();
    let wrong = bench.path("wrong.mcap");
    let spoil = |at: usize| {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        std::fs::write(&wrong, &changed).unwrap();
    };
    spoil((chunk.start + chunk.end) / 2);
    for done in commands(&bench, &wrong, &[]) {
        assert!(done.code == Some(1) && done.says("damaged-recording"), "{done:?}");
        assert!(done.stdout.is_empty() && !bench.path("tables").exists(), "{done:?}");
    }
    for done in commands(&bench, &wrong, &["--accept-incomplete"]) {
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
    // The metadata: a digit of the period, and of the scenario.
    for (text, digit) in [("period_ns", 13), ("decay_rate", 0)] {
        let at = bytes.windows(text.len()).position(|window| window == text.as_bytes());
        spoil(at.map_or_else(|| panic!("there is no {text}"), |at| at + digit));
        for done in commands(&bench, &wrong, &["--accept-incomplete"]).into_iter().chain([page(&wrong)]) {
            assert!(done.code == Some(1) && done.stderr.contains("checksum of its metadata"), "{text}: {done:?}");
        }
    }
    std::fs::write(&wrong, &bytes[..chunk.end + 100]).unwrap();
    for done in commands(&bench, &wrong, &[]) {
        assert!(done.code == Some(1) && done.stdout.is_empty(), "{done:?}");
        assert!(done.stderr.contains("is not complete: it has no end") && done.stderr.contains(" of 2000"), "{done:?}");
        assert!(done.stderr.contains("--accept-incomplete"), "{done:?}");
    }
    for done in commands(&bench, &wrong, &["--accept-incomplete"]).into_iter().chain([page(&wrong)]) {
        assert!(done.code == Some(0) && done.stderr.contains("not complete"), "{done:?}");
    }
}

/// Two files that a recording is changed into have the right checksums: such as somebody makes on purpose.
#[test]
fn what_a_recording_says_is_shown_and_not_obeyed() {
    let bench = Bench::new();
    let (path, wrong) = (record(&bench, "run.mcap", "0.1"), bench.path("wrong.mcap"));
    let nasty = "\u{1b}]0;owned\u{7}\u{9b}2J\u{202e}<script>alert(1)</script>";
    rewrite_metadata(&path, &wrong, |name, entries| {
        if name == "corotate.end" {
            entries.insert("complete".to_owned(), "false".to_owned());
            entries.insert("problem".to_owned(), nasty.to_owned());
        }
    });
    let report = bench.run(&["report", wrong.to_str().unwrap(), "--out", "page.html"]);
    for flags in [&[][..], &["--accept-incomplete"]] {
        for done in commands(&bench, &wrong, flags).iter().chain([&report]) {
            let text = format!("{}{}", done.stdout, done.stderr);
            assert!(text.contains("owned") && text.contains("\\u{1b}"), "{done:?}");
            assert!(!text.contains(['\u{1b}', '\u{7}', '\u{9b}', '\u{202e}']), "{done:?}");
        }
    }
    let page = std::fs::read_to_string(bench.path("page.html")).unwrap();
    assert!(page.contains("owned") && page.matches("<script").count() == 1, "its own script, and no other");
    assert!(!page.contains(['\u{1b}', '\u{7}', '\u{9b}']));
    // Another scenario than the one whose hash is beside it.
    rewrite_metadata(&path, &wrong, |_, entries| {
        entries.entry("scenario".to_owned()).and_modify(|text| *text = text.replace("seed = 1", "seed = 2"));
    });
    for done in commands(&bench, &wrong, &["--accept-incomplete"]) {
        assert!(done.code == Some(1) && done.stderr.contains("has the hash"), "{done:?}");
    }
}

/// Whatever lengths a file tells, no more memory is asked for than it could fill.
#[test]
fn a_length_is_no_reason_to_ask_for_memory() {
    let bench = Bench::new();
    let path = record(&bench, "run.mcap", "2");
    let bytes = std::fs::read(&path).unwrap();
    let (wrong, packed) = (bench.path("wrong.mcap"), packed(&bytes));
    let program = bench.command().get_program().to_owned();
    let script = format!("ulimit -v 400000; exec {} export wrong.mcap --csv tables", program.to_str().unwrap());
    let mut lengths: Vec<Vec<u8>> = (1..12).map(|part| bytes[..bytes.len() * part / 12].to_vec()).collect();
    // The length of a chunk, what it claims to be when unpacked, and how much of it is packed.
    for field in [-53_isize + 1, -53 + 9 + 16, -53 + 9 + 36] {
        let mut changed = bytes.clone();
        let at = packed[1].start.checked_add_signed(field).unwrap();
        changed[at..at + 8].copy_from_slice(&(1_u64 << 34).to_le_bytes());
        lengths.push(changed);
    }
    for (number, length) in lengths.iter().enumerate() {
        std::fs::write(&wrong, length).unwrap();
        let done = bench.start_program(Path::new("bash"), &["-c", &script]).wait();
        assert_eq!(done.code, Some(1), "{number}: {done:?}");
    }
}
