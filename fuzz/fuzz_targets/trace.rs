//! Any bytes as pages of a kernel trace and as their formats, and a late tick in what was decoded: no part of a delay is blamed
//! twice. Also any text as the report of late ticks.
#![no_main]

use arbitrary::Arbitrary;
use corotate::late::LateReport;
use corotate_trace::{Duty, Event, Facts, Formats, Page, Phase, Window};
use libfuzzer_sys::fuzz_target;
use std::path::Path;
use std::sync::OnceLock;

const PAGE: usize = 4096;

#[derive(Debug, Arbitrary)]
struct Input<'a> {
    /// Changes of recorded pages: place and bytes.
    changes: Vec<(u16, &'a [u8])>,
    /// A page for each core, beside the recorded ones.
    pages: Vec<&'a [u8]>,
    format: &'a str,
    report: &'a [u8],
    tid: i32,
    facts: (u64, bool, bool),
    /// Ends of the phases as fractions of the window.
    phases: Vec<(u8, u8)>,
}

struct Recorded {
    kernels: [Formats; 2],
    pages: Vec<u8>,
}

fn recorded() -> &'static Recorded {
    static RECORDED: OnceLock<Recorded> = OnceLock::new();
    RECORDED.get_or_init(|| {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../crates/trace/tests-data"));
        let kernels =
            ["6.18", "5.4"].map(|kernel| Formats::read(&root.join(kernel)).expect("recorded formats are valid"));
        Recorded { kernels, pages: std::fs::read(root.join("pages-6.18.bin")).expect("the recorded pages exist") }
    })
}

/// Reads a tracefs whose `sched_switch` has the format `text`.
fn read_formats(text: &str) {
    let root = tempfile::tempdir().expect("a directory");
    let recorded = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../crates/trace/tests-data/6.18/events"));
    let events = root.path().join("events");
    std::fs::create_dir_all(events.join("sched/sched_switch")).expect("the disk has space");
    std::fs::copy(recorded.join("header_page"), events.join("header_page")).expect("the disk has space");
    std::fs::write(events.join("sched/sched_switch/format"), text).expect("the disk has space");
    if let Ok(formats) = Formats::read(root.path()) {
        decode(&formats, 0, &recorded_page(0), &mut Vec::new());
    }
}

fn recorded_page(number: usize) -> Vec<u8> {
    recorded().pages[number * PAGE..][..PAGE].to_vec()
}

fn decode(formats: &Formats, core: usize, bytes: &[u8], events: &mut Vec<Event>) {
    if let Some(page) = Page::new(bytes, formats) {
        formats.decode(&page, core, events);
    }
}

fn blame(events: Vec<Event>, input: &Input) {
    let from_ns = events.iter().map(|event| event.ns).min().unwrap_or(0);
    let to_ns = events.iter().map(|event| event.ns).max().unwrap_or(0).min(from_ns.saturating_add(1 << 40));
    let window = Window::new(events, from_ns, to_ns);
    let at = |fraction: u8| from_ns + (to_ns - from_ns) / 255 * u64::from(fraction);
    let mut end = 0_u8;
    let mut phases = Vec::new();
    for (length, duty) in &input.phases {
        let (begin, next) = (end, end.saturating_add(*length));
        let gap = (at(begin), at(next));
        let duty = match duty % 3 {
            0 => Duty::Timer { gap },
            1 => Duty::Wake { sender: input.tid.wrapping_add(1), timed: duty & 4 != 0, gap },
            _ => Duty::Compute,
        };
        phases.push(Phase { from_ns: at(begin), to_ns: at(next), duty });
        end = next;
    }
    let (throttled_ns, limited, major_faults) = input.facts;
    let causes = window.blame(input.tid, Facts { throttled_ns, limited, major_faults }, &phases);
    let explained_us: f64 = causes.iter().map(|cause| cause.us).sum();
    let measured_us = (at(end) - from_ns) as f64 / 1e3;
    assert!(explained_us <= measured_us * (1.0 + 1e-9) + 1e-3, "{explained_us} of {measured_us}: {causes:?}");
    assert!(causes.iter().all(|cause| cause.us >= 0.0), "{causes:?}");
}

fuzz_target!(|input: Input| {
    let Recorded { kernels, pages } = recorded();
    let mut changed = pages.clone();
    for (at, raw) in &input.changes {
        let at = usize::from(*at) % changed.len();
        let count = raw.len().min(changed.len() - at);
        changed[at..at + count].copy_from_slice(&raw[..count]);
    }
    for formats in kernels {
        let mut events = Vec::new();
        for (core, bytes) in changed.chunks(PAGE).chain(input.pages.iter().copied()).enumerate() {
            decode(formats, core, bytes, &mut events);
        }
        blame(events, &input);
    }
    read_formats(input.format);
    if let Ok(report) = LateReport::parse(input.report) {
        let _ = report.worst(10);
    }
});
