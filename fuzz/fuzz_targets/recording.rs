//! Any bytes as a recording, and as samples and metadata of a complete one with valid checksums, which random bytes
//! never have. A recording that opens can be exported, compared with itself and replayed.
#![no_main]

use corotate::config::SHIPPED;
use corotate::launch::{Launch, run};
use corotate::record::{Recording, Tolerances, diff, export_csv, replay_in_process};
use corotate::runtime::RoleId;
use corotate::scenario::Scenario;
use libfuzzer_sys::fuzz_target;
use mcap::records::Metadata;
use std::cell::OnceCell;
use std::path::Path;
use std::sync::atomic::AtomicUsize;

thread_local! {
    static BENCH: OnceCell<Bench> = const { OnceCell::new() };
}

/// A complete recording, and the directory of the damaged ones.
struct Bench {
    directory: tempfile::TempDir,
    whole: Vec<u8>,
}

impl Bench {
    fn new() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let short = ["clock=in-process", "duration_s=0.02", "accept={}"].map(str::to_owned);
        let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &short).expect("a shipped scenario is valid");
        let path = directory.path().join("whole.mcap");
        run(&scenario, &mut Launch { record: Some(path.clone()), ..Launch::new(&AtomicUsize::new(0), &mut |_| {}) })
            .expect("the scenario runs");
        Self { whole: std::fs::read(path).expect("the recording exists"), directory }
    }

    /// Returns the complete recording with other bytes in its samples and metadata.
    fn rewritten(&self, changes: &[(u16, &[u8])]) -> Vec<u8> {
        let mut file = std::io::Cursor::new(Vec::new());
        let mut writer = mcap::Writer::new(&mut file).expect("writing to memory succeeds");
        let mut changes = changes.iter().peekable();
        let mut change = |number: u16, bytes: &mut Vec<u8>| {
            while let Some((_, raw)) = changes.next_if(|(at, _)| at % 256 == number) {
                if let Some((at, raw)) = raw.split_first() {
                    let at = usize::from(*at) % bytes.len().max(1);
                    let count = raw.len().min(bytes.len() - at);
                    bytes[at..at + count].copy_from_slice(&raw[..count]);
                }
            }
        };
        for (number, message) in mcap::MessageStream::new(&self.whole).expect("the recording is complete").enumerate() {
            let mut message = message.expect("the recording is complete");
            let mut data = message.data.to_vec();
            change(number as u16, &mut data);
            message.data = data.into();
            writer.write(&message).expect("writing to memory succeeds");
        }
        let summary = mcap::Summary::read(&self.whole).expect("the recording is complete").expect("it has a summary");
        for index in &summary.metadata_indexes {
            let Metadata { name, metadata } =
                mcap::read::metadata(&self.whole, index).expect("the recording is complete");
            let metadata = metadata.into_iter().map(|(key, value)| {
                let mut bytes = value.into_bytes();
                change(255, &mut bytes);
                (key, String::from_utf8_lossy(&bytes).into_owned())
            });
            writer
                .write_metadata(&Metadata { name, metadata: metadata.collect() })
                .expect("writing to memory succeeds");
        }
        writer.finish().expect("writing to memory succeeds");
        drop(writer);
        file.into_inner()
    }

    fn read(&self, path: &Path) {
        let Ok(recording) = Recording::open(path) else { return };
        let tables = export_csv(&recording, &self.directory.path().join("tables"));
        assert!(tables.is_ok() || recording.damage().is_some(), "{tables:?}");
        if let Ok(comparison) = diff(&recording, &recording, Tolerances::default()) {
            assert!(comparison.first().is_none());
        }
        let Ok(scenario) = recording.scenario_for_replay() else { return };
        if recording.check_layouts(&scenario).is_ok() {
            for role in RoleId::all(&scenario) {
                let _ = replay_in_process(&recording, &scenario, role);
            }
        }
    }
}

fuzz_target!(|input: (u8, &[u8], Vec<(u16, &[u8])>)| {
    BENCH.with(|bench| {
        let bench = bench.get_or_init(Bench::new);
        let bytes = match input.0 % 4 {
            0 => input.1.to_vec(),
            1 => {
                // The complete recording, truncated or with changed bytes.
                let mut bytes = bench.whole.clone();
                for (at, raw) in &input.2 {
                    let at = usize::from(*at) % bytes.len();
                    let count = raw.len().min(bytes.len() - at);
                    bytes[at..at + count].copy_from_slice(&raw[..count]);
                }
                bytes
            }
            _ => bench.rewritten(&input.2),
        };
        let path = bench.directory.path().join("fuzzed.mcap");
        std::fs::write(&path, bytes).expect("the disk has space");
        bench.read(&path);
    });
});
