//! The kernel's trace pages: reads their formats from tracefs and decodes their bytes to events.
//!
//! Must not panic, loop or step back in time on damaged bytes.

use crate::event::{Event, EventKind, Task, TaskState};
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// An error of reading a format: it is missing or has another form.
#[derive(Debug, thiserror::Error)]
#[error("cannot read the trace format {}: {source}; run without a trace, and report it with `uname -r`", path.display())]
pub struct FormatError {
    /// The format file.
    pub path: PathBuf,
    /// The reason.
    pub source: io::Error,
}

/// A kind of event to record.
#[derive(Debug)]
struct Wanted {
    /// The group and the name, as in the path below `events`.
    event: &'static str,
    kind: Kind,
    /// The fields that [`Formats::kind`] reads, in its order.
    fields: &'static [&'static str],
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Switch,
    Waking,
    IrqEntry,
    IrqExit,
    SoftirqEntry,
    SoftirqExit,
    VectorEntry(&'static str),
    VectorExit,
    PageFault,
}

const fn wanted(event: &'static str, kind: Kind, fields: &'static [&'static str]) -> Wanted {
    Wanted { event, kind, fields }
}

/// The event without which a trace is useless.
const REQUIRED: &str = "sched/sched_switch";
/// The event of page faults, which is recorded for some threads only.
pub(crate) const PAGE_FAULT: &str = "exceptions/page_fault_user";

/// The wanted events, the frequent ones first. Kernels other than x86 lack `irq_vectors` and `exceptions`.
static WANTED: [Wanted; 17] = [
    wanted(
        REQUIRED,
        Kind::Switch,
        &["prev_comm", "prev_pid", "prev_prio", "next_comm", "next_pid", "next_prio", "prev_state"],
    ),
    wanted("sched/sched_waking", Kind::Waking, &["comm", "pid", "prio", "target_cpu", "common_pid"]),
    wanted("irq_vectors/local_timer_entry", Kind::VectorEntry("local_timer"), &[]),
    wanted("irq_vectors/local_timer_exit", Kind::VectorExit, &[]),
    wanted("irq/softirq_entry", Kind::SoftirqEntry, &["vec"]),
    wanted("irq/softirq_exit", Kind::SoftirqExit, &[]),
    wanted("irq/irq_handler_entry", Kind::IrqEntry, &["irq", "name"]),
    wanted("irq/irq_handler_exit", Kind::IrqExit, &[]),
    wanted("irq_vectors/reschedule_entry", Kind::VectorEntry("reschedule"), &[]),
    wanted("irq_vectors/reschedule_exit", Kind::VectorExit, &[]),
    wanted("irq_vectors/call_function_single_entry", Kind::VectorEntry("call_function_single"), &[]),
    wanted("irq_vectors/call_function_single_exit", Kind::VectorExit, &[]),
    wanted("irq_vectors/call_function_entry", Kind::VectorEntry("call_function"), &[]),
    wanted("irq_vectors/call_function_exit", Kind::VectorExit, &[]),
    wanted("irq_vectors/irq_work_entry", Kind::VectorEntry("irq_work"), &[]),
    wanted("irq_vectors/irq_work_exit", Kind::VectorExit, &[]),
    wanted(PAGE_FAULT, Kind::PageFault, &["common_pid"]),
];

/// The states of a task, for a kernel whose print format does not list them.
const DEFAULT_STATES: &str =
    r#"{ 1, "S" }, { 2, "D" }, { 4, "T" }, { 8, "t" }, { 16, "X" }, { 32, "Z" }, { 128, "I" }"#;

/// The place of a value in a record.
#[derive(Debug, Clone, Copy, Default)]
struct Field {
    offset: usize,
    size: usize,
    signed: bool,
    /// True if the field holds the place of a string: its offset in the lower 16 bits, its length in the upper ones.
    indirect: bool,
}

impl Field {
    /// Parses a line such as `field:pid_t prev_pid; offset:24; size:4; signed:1;` to the field and its name.
    fn parse(line: &str) -> Option<(&str, Self)> {
        let (mut name, mut field) = (None, Self::default());
        for part in line.split(';') {
            match part.trim().split_once(':') {
                Some(("field", declaration)) => {
                    field.indirect = declaration.contains("__data_loc");
                    name = declaration.split_whitespace().next_back()?.split('[').next();
                }
                Some(("offset", number)) => field.offset = number.parse().ok()?,
                Some(("size", number)) => field.size = number.parse().ok()?,
                Some(("signed", number)) => field.signed = number == "1",
                _ => {}
            }
        }
        Some((name?, field))
    }

    /// Finds fields by their names in the text of a format.
    fn find<const N: usize>(text: &str, names: [&str; N]) -> io::Result<[Self; N]> {
        let fields = Self::find_all(text, &names)?;
        Ok(fields.try_into().expect("one field per name"))
    }

    fn find_all(text: &str, names: &[&str]) -> io::Result<Vec<Self>> {
        let find = |name: &&str| {
            let field = text.lines().filter_map(Self::parse).find(|(found, _)| found == name);
            field.map(|(_, field)| field).ok_or_else(|| invalid(format!("field `{name}` is missing")))
        };
        names.iter().map(find).collect()
    }

    fn bytes<'a>(&self, record: &'a [u8]) -> Option<&'a [u8]> {
        record.get(self.offset..self.offset.checked_add(self.size)?)
    }

    /// Returns the bits of a number of at most 8 bytes.
    fn bits(&self, record: &[u8]) -> Option<u64> {
        let bytes = self.bytes(record)?;
        let mut word = [0; size_of::<u64>()];
        word.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(u64::from_le_bytes(word))
    }

    /// Returns a number, if `T` can represent it.
    fn number<T: TryFrom<i64>>(&self, record: &[u8]) -> Option<T> {
        let mut value = self.bits(record)?.cast_signed();
        if self.signed {
            let unused = u64::BITS - 8 * u32::try_from(self.size).ok()?;
            value = value.checked_shl(unused)? >> unused;
        }
        T::try_from(value).ok()
    }

    /// Returns a string without the NUL that ends it.
    fn text(&self, record: &[u8]) -> Option<String> {
        let bytes = if self.indirect {
            let place = self.bits(record)?;
            let [start, length] = [place, place >> 16].map(|half| usize::from(half as u16));
            record.get(start..start + length)?
        } else {
            self.bytes(record)?
        };
        let text = bytes.split(|&byte| byte == 0).next()?;
        Some(String::from_utf8_lossy(text).into_owned())
    }
}

/// The format of the records of one event.
#[derive(Debug, Clone)]
pub struct Format {
    id: u16,
    wanted: &'static Wanted,
    fields: Vec<Field>,
}

impl Format {
    /// Parses the text of a format file.
    fn parse(text: &str, wanted: &'static Wanted) -> io::Result<Self> {
        let id = text.lines().find_map(|line| line.strip_prefix("ID:")?.trim().parse().ok());
        let id = id.ok_or_else(|| invalid("`ID` is missing".into()))?;
        Ok(Self { id, wanted, fields: Field::find_all(text, wanted.fields)? })
    }
}

/// The formats of the recorded events and of the pages that hold them.
#[derive(Debug, Clone)]
pub struct Formats {
    events: Vec<Format>,
    timestamp: Field,
    commit: Field,
    data: Field,
    /// The bits of `prev_state`; the lowest set bit decides.
    states: Vec<(u64, TaskState)>,
}

impl Formats {
    /// Reads the formats below a tracefs or one of its instances. An event that the kernel lacks is left out.
    ///
    /// # Errors
    /// [`FormatError`] if a format is unreadable, or if `sched_switch` or the page header is missing.
    pub fn read(root: &Path) -> Result<Self, FormatError> {
        let path = root.join("events/header_page");
        let header = read_header(&path).and_then(|text| Field::find(&text, ["timestamp", "commit", "data"]));
        let [timestamp, commit, data] = header.map_err(|source| FormatError { path, source })?;
        let mut formats = Self { events: Vec::new(), timestamp, commit, data, states: Vec::new() };
        for wanted in &WANTED {
            let path = root.join("events").join(wanted.event).join("format");
            let text = match fs::read_to_string(&path) {
                Ok(text) => text,
                Err(error) if error.kind() == io::ErrorKind::NotFound && wanted.event != REQUIRED => continue,
                Err(source) => return Err(FormatError { path, source }),
            };
            if wanted.event == REQUIRED {
                let states = task_states(&text);
                formats.states = if states.is_empty() { task_states(DEFAULT_STATES) } else { states };
            }
            let format = Format::parse(&text, wanted).map_err(|source| FormatError { path, source })?;
            formats.events.push(format);
        }
        Ok(formats)
    }

    /// Returns the recorded events as paths below `events`.
    pub(crate) fn events(&self) -> impl Iterator<Item = &'static str> {
        self.events.iter().map(|format| format.wanted.event)
    }

    /// Returns the size of a page in bytes.
    pub(crate) fn page_size(&self) -> usize {
        self.data.offset.saturating_add(self.data.size)
    }

    /// Decodes a page of core `core` and appends its events. Records that are damaged or of other events are left out.
    pub fn decode(&self, page: &Page, core: usize, events: &mut Vec<Event>) {
        if page.lost {
            events.push(Event { ns: page.start_ns, core, kind: EventKind::Lost });
        }
        let records = Records { rest: &page.bytes, ns: page.start_ns };
        events.extend(records.filter_map(|(ns, record)| Some(Event { ns, core, kind: self.kind(record)? })));
    }

    /// Decodes a record.
    fn kind(&self, record: &[u8]) -> Option<EventKind> {
        // Every kernel has `common_type` here.
        let id = u16::from_le_bytes(*record.first_chunk()?);
        let format = self.events.iter().find(|format| format.id == id)?;
        let task = |comm: &Field, tid: &Field, priority: &Field| {
            let (tid, priority) = (tid.number(record)?, priority.number(record)?);
            Some(Task { tid, name: comm.text(record)?, priority })
        };
        Some(match (format.wanted.kind, &format.fields[..]) {
            (Kind::Switch, [from_comm, from_tid, from_priority, to_comm, to_tid, to_priority, state]) => {
                let state = self.task_state(state.bits(record)?);
                let from = task(from_comm, from_tid, from_priority)?;
                EventKind::Switch { from, state, to: task(to_comm, to_tid, to_priority)? }
            }
            (Kind::Waking, [comm, tid, priority, target, by]) => {
                let (by, target) = (by.number(record)?, target.number(record)?);
                EventKind::Waking { by, task: task(comm, tid, priority)?, target }
            }
            (Kind::IrqEntry, [irq, name]) => EventKind::IrqEntry { irq: irq.number(record)?, name: name.text(record)? },
            (Kind::IrqExit, _) => EventKind::IrqExit,
            (Kind::SoftirqEntry, [vector]) => EventKind::SoftirqEntry { vector: vector.number(record)? },
            (Kind::SoftirqExit, _) => EventKind::SoftirqExit,
            (Kind::VectorEntry(name), _) => EventKind::VectorEntry { name },
            (Kind::VectorExit, _) => EventKind::VectorExit,
            (Kind::PageFault, [tid]) => EventKind::PageFault { tid: tid.number(record)? },
            _ => return None,
        })
    }

    /// Returns the state that `prev_state` stands for. A preempted task has no bit set that has a name.
    fn task_state(&self, bits: u64) -> TaskState {
        let named = self.states.iter().find(|(bit, _)| bits & bit != 0);
        named.map_or(TaskState::Runnable, |&(_, state)| state)
    }
}

/// Reads the page header's format at once: the kernel returns nothing to a second read, even if the first one was short.
fn read_header(path: &Path) -> io::Result<String> {
    let mut bytes = vec![0; 4096];
    let length = File::open(path)?.read(&mut bytes)?;
    bytes.truncate(length);
    String::from_utf8(bytes).map_err(|error| invalid(error.to_string()))
}

/// Parses the states of tasks from the print format of `sched_switch`: bits and letters such as `{ 0x0001, "S" }`.
fn task_states(text: &str) -> Vec<(u64, TaskState)> {
    let parse = |text: &str| {
        let (bit, letter) = text.split_once('}')?.0.split_once(',')?;
        let bit = match bit.trim().strip_prefix("0x") {
            Some(digits) => u64::from_str_radix(digits, 16).ok()?,
            None => bit.trim().parse().ok()?,
        };
        let state = match letter.trim().trim_matches('"') {
            "S" | "I" => TaskState::Sleeping,
            "D" => TaskState::Uninterruptible,
            "T" | "t" => TaskState::Stopped,
            _ => TaskState::Gone,
        };
        Some((bit, state))
    };
    text.split('{').filter_map(parse).collect()
}

/// A page of the trace of one core.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page {
    /// The time from which its first record counts, ns.
    pub start_ns: u64,
    /// The records.
    pub bytes: Box<[u8]>,
    /// True if the kernel has dropped events before this page.
    pub lost: bool,
}

impl Page {
    /// The bits of the header's `commit` that hold the length of the records.
    const LENGTH: u64 = (1 << 27) - 1;
    /// Bits of `commit`: events are missing, and their number follows the records.
    const LOST: u64 = 1 << 31 | 1 << 30;

    /// Copies the records of a page as read from `trace_pipe_raw`. Returns nothing if its header is incomplete, or if it holds
    /// no news.
    pub fn new(bytes: &[u8], formats: &Formats) -> Option<Self> {
        let start_ns = formats.timestamp.bits(bytes)?;
        let commit = formats.commit.bits(bytes)?;
        let records = bytes.get(formats.data.offset..)?;
        let length = records.len().min(usize::try_from(commit & Self::LENGTH).ok()?);
        let lost = commit & Self::LOST != 0;
        (lost || length > 0).then(|| Self { start_ns, bytes: records[..length].into(), lost })
    }
}

/// An iterator over the times and contents of a page's data records.
///
/// Source: `include/linux/ring_buffer.h` and `check_buffer` in `kernel/trace/ring_buffer.c`.
struct Records<'a> {
    rest: &'a [u8],
    ns: u64,
}

impl<'a> Records<'a> {
    const PADDING: u32 = 29;
    const TIME_EXTEND: u32 = 30;
    const TIME_STAMP: u32 = 31;
    /// The bits of a time that a record of a time lacks.
    const TIME_HIGH: u64 = 0x1f << 59;

    /// Returns a time from its lower 59 bits. It is near the time of the previous record, and not before it.
    fn absolute(&self, low: u64) -> u64 {
        let high = self.ns & Self::TIME_HIGH;
        let ns = low | high;
        if high != 0 && ns < self.ns { ns.saturating_add(1 << 59) } else { ns.max(self.ns) }
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = (u64, &'a [u8]);

    /// Returns the next data record. Each turn of the loop consumes at least a header.
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let (header, body) = split_word(self.rest)?;
            let (kind, delta) = (header & 0x1f, u64::from(header >> 5));
            // The content follows the header: its length is in the kind, or in the word before it, which it counts.
            let (content, end) = match kind {
                Self::TIME_EXTEND | Self::TIME_STAMP => {
                    let (high, rest) = split_word(body)?;
                    let time = u64::from(high) << 27 | delta;
                    self.ns = if kind == Self::TIME_STAMP { self.absolute(time) } else { self.ns.saturating_add(time) };
                    self.rest = rest;
                    continue;
                }
                Self::PADDING if delta == 0 => {
                    // The rest of the page is empty.
                    self.rest = &[];
                    return None;
                }
                0 | Self::PADDING => (size_of::<u32>(), usize::try_from(split_word(body)?.0).ok()?),
                words => (0, usize::try_from(words).ok()? * size_of::<u32>()),
            };
            self.rest = body.get(end..).unwrap_or_default();
            if kind == Self::PADDING {
                // A discarded event. Its delta is never 0: the kernel writes 1 instead.
                self.ns = self.ns.saturating_add(if delta == 1 { 0 } else { delta });
                continue;
            }
            self.ns = self.ns.saturating_add(delta);
            return Some((self.ns, body.get(content..end)?));
        }
    }
}

/// Splits the first 32-bit word from bytes.
fn split_word(bytes: &[u8]) -> Option<(u32, &[u8])> {
    let (word, rest) = bytes.split_first_chunk()?;
    Some((u32::from_le_bytes(*word), rest))
}

fn invalid(reason: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns the formats of a kernel from the files of its tracefs.
    fn formats(kernel: &str) -> Formats {
        Formats::read(&data(kernel)).unwrap()
    }

    fn data(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests-data").join(name)
    }

    fn decode(formats: &Formats, bytes: &[u8]) -> Vec<Event> {
        let mut events = Vec::new();
        if let Some(page) = Page::new(bytes, formats) {
            formats.decode(&page, 0, &mut events);
        }
        events
    }

    /// Returns the text between `start` and `end`, or the end of the line.
    fn between<'a>(text: &'a str, start: &str, end: &str) -> &'a str {
        let rest = text.split_once(start).unwrap_or_else(|| panic!("{start} in {text}")).1;
        rest.split_once(end).map_or(rest, |(inner, _)| inner)
    }

    /// Parses a line of the kernel's text, such as `…-21 [001] d..2. 87.123456: sched_waking: comm=a pid=1 …`, to the time in µs
    /// and the event.
    fn parse(line: &str) -> (u64, EventKind) {
        let (before, text) = line.split_once(": ").unwrap();
        let running = before.split_once(" [").unwrap().0.trim_end().rsplit('-').next().unwrap().parse().unwrap();
        let (seconds, micros) = before.rsplit(' ').next().unwrap().split_once('.').unwrap();
        let us = seconds.parse::<u64>().unwrap() * 1_000_000 + micros.parse::<u64>().unwrap();
        let (event, text) = text.split_once(": ").unwrap();
        let task = |prefix: &str| Task {
            name: between(text, &format!("{prefix}comm="), &format!(" {prefix}pid=")).into(),
            tid: between(text, &format!(" {prefix}pid="), " ").parse().unwrap(),
            priority: between(text, &format!(" {prefix}prio="), " ").parse().unwrap(),
        };
        let state = |letters: &str| match letters {
            "R" | "R+" => TaskState::Runnable,
            "S" | "I" => TaskState::Sleeping,
            "D" => TaskState::Uninterruptible,
            "T" | "t" => TaskState::Stopped,
            _ => TaskState::Gone,
        };
        let vectors = ["local_timer", "reschedule", "call_function", "call_function_single", "irq_work"];
        let kind = match event {
            "sched_switch" => EventKind::Switch {
                from: task("prev_"),
                state: state(between(text, "prev_state=", " ")),
                to: task("next_"),
            },
            "sched_waking" => EventKind::Waking {
                by: running,
                task: task(""),
                target: between(text, "target_cpu=", " ").parse().unwrap(),
            },
            "irq_handler_entry" => EventKind::IrqEntry {
                irq: between(text, "irq=", " ").parse().unwrap(),
                name: between(text, "name=", "\n").into(),
            },
            "irq_handler_exit" => EventKind::IrqExit,
            "softirq_entry" => EventKind::SoftirqEntry { vector: between(text, "vec=", " ").parse().unwrap() },
            "softirq_exit" => EventKind::SoftirqExit,
            "page_fault_user" => EventKind::PageFault { tid: running },
            vector => match vector.strip_suffix("_entry") {
                Some(found) => {
                    EventKind::VectorEntry { name: vectors.into_iter().find(|name| *name == found).unwrap() }
                }
                None => EventKind::VectorExit,
            },
        };
        (us, kind)
    }

    /// Recorded on Linux 6.18: pages of a core, and the kernel's text of the same events.
    fn recorded() -> (Vec<u8>, String) {
        (fs::read(data("pages-6.18.bin")).unwrap(), fs::read_to_string(data("pages-6.18.txt")).unwrap())
    }

    #[test]
    fn recorded_pages_decode_to_the_events_of_the_kernels_text() {
        let (bytes, text) = recorded();
        let formats = formats("6.18");
        let events: Vec<Event> = bytes.chunks(formats.page_size()).flat_map(|page| decode(&formats, page)).collect();
        assert!(matches!(events[0].kind, EventKind::Lost));
        let found: Vec<_> = events
            .into_iter()
            .filter(|event| event.kind != EventKind::Lost)
            .map(|event| ((event.ns + 500) / 1000, event.kind))
            .collect();
        let expected: Vec<_> = text.lines().filter(|line| line.contains("] ")).map(parse).collect();
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(found, expected);
        }
    }

    /// A page in the making.
    #[derive(Default)]
    struct Draft(Vec<u8>);

    impl Draft {
        fn header(mut self, kind: u32, delta: u32) -> Self {
            self.0.extend((kind | delta << 5).to_le_bytes());
            self
        }

        fn word(mut self, word: u32) -> Self {
            self.0.extend(word.to_le_bytes());
            self
        }

        /// Appends a record of `softirq_exit`, padded to 12 bytes, that names its length in its header.
        fn event(self, delta: u32) -> Self {
            self.header(3, delta).word(222).word(0).word(0)
        }

        fn page(self, start_ns: u64, flags: u64) -> Vec<u8> {
            let commit = self.0.len() as u64 | flags;
            [&start_ns.to_le_bytes()[..], &commit.to_le_bytes(), &self.0, &[0; 64]].concat()
        }

        /// Returns the times of the page's events.
        fn times(self, start_ns: u64) -> Vec<u64> {
            decode(&formats("6.18"), &self.page(start_ns, 0)).iter().map(|event| event.ns).collect()
        }
    }

    #[test]
    fn records_of_times_and_gaps_move_the_time() {
        assert_eq!(Draft::default().event(5).event(7).times(100), [105, 112]);
        assert_eq!(Draft::default().header(30, 1).word(2).event(3).times(100), [100 + 1 + (2 << 27) + 3]);
        // An absolute time keeps the upper bits, and carries into them.
        assert_eq!(Draft::default().header(31, 9).word(1).event(1).times(100), [(1 << 27) + 9 + 1]);
        let late = (3 << 59) + (1 << 40);
        assert_eq!(Draft::default().header(31, 9).word(1 << 20).event(0).times(late), [(3 << 59) + (1 << 47) + 9]);
        assert_eq!(Draft::default().header(31, 9).word(1).event(0).times(late), [(4 << 59) + (1 << 27) + 9]);
        // Discarded events, the second one with a delta of 0.
        let discarded = Draft::default().header(29, 10).word(8).word(0).header(29, 1).word(4).event(2);
        assert_eq!(discarded.times(100), [112]);
        // A length in a word, and the end of a page.
        let long = Draft::default().header(0, 1).word(12).word(222).word(0).event(1).header(29, 0).word(0).event(1);
        assert_eq!(long.times(0), [1, 2]);
    }

    #[test]
    fn an_absolute_time_before_the_last_event_does_not_step_back() {
        assert_eq!(
            Draft::default().event(500).header(31, 3).word(0).event(1).times(1 << 30),
            [(1 << 30) + 500, (1 << 30) + 501]
        );
        assert_eq!(Draft::default().header(30, 0).word(u32::MAX).event(1).times(u64::MAX - 1), [u64::MAX]);
    }

    #[test]
    fn lost_events_precede_the_others() {
        let formats = formats("6.18");
        let kinds = |flags: u64| {
            let events = decode(&formats, &Draft::default().event(5).page(100, flags));
            events.into_iter().map(|event| (event.ns, event.kind)).collect::<Vec<_>>()
        };
        assert_eq!(kinds(0), [(105, EventKind::SoftirqExit)]);
        for flags in [1 << 31, 3 << 30] {
            assert_eq!(kinds(flags), [(100, EventKind::Lost), (105, EventKind::SoftirqExit)]);
        }
        assert_eq!(Page::new(&Draft::default().page(100, 0), &formats), None);
        assert!(Page::new(&Draft::default().page(100, 1 << 31), &formats).unwrap().lost);
    }

    #[test]
    fn an_older_kernel_has_other_offsets_and_fewer_events() {
        let formats = formats("5.4");
        assert_eq!(formats.events().collect::<Vec<_>>(), [REQUIRED, "sched/sched_waking"]);
        assert_eq!(formats.page_size(), 4096);
        let comm = |draft: Draft, name: &str| {
            let mut bytes = [0; 16];
            bytes[..name.len()].copy_from_slice(name.as_bytes());
            bytes.chunks(4).fold(draft, |draft, word| draft.word(u32::from_le_bytes(word.try_into().unwrap())))
        };
        // type, pid | comm, pid, prio, success, target_cpu
        let waking = comm(Draft::default().header(10, 1).word(311).word(7), "plant");
        let waking = waking.word(21).word(19).word(1).word(3);
        // type, pid | prev_comm, prev_pid, prev_prio, prev_state, next_comm, next_pid, next_prio
        let switch = comm(waking.header(16, 1).word(314).word(21), "plant").word(21).word((-1_i32).cast_unsigned());
        let switch = comm(switch.word(0x81).word(0), "swapper/1").word(0).word(120);
        let task = |name: &str, tid, priority| Task { tid, name: name.into(), priority };
        let events = decode(&formats, &switch.page(0, 0));
        assert_eq!(events[0].kind, EventKind::Waking { by: 7, task: task("plant", 21, 19), target: 3 });
        let (from, to) = (task("plant", 21, -1), task("swapper/1", 0, 120));
        assert_eq!(events[1].kind, EventKind::Switch { from, state: TaskState::Sleeping, to });
        assert_eq!(events.len(), 2);
    }

    #[test]
    fn the_kernel_names_the_states() {
        let new = formats("6.18");
        let state = |bits| new.task_state(bits);
        assert_eq!([0, 0x100].map(state), [TaskState::Runnable; 2]);
        assert_eq!([1, 0x80].map(state), [TaskState::Sleeping; 2]);
        assert_eq!(state(2), TaskState::Uninterruptible);
        assert_eq!([4, 8].map(state), [TaskState::Stopped; 2]);
        assert_eq!([0x10, 0x20, 0x40].map(state), [TaskState::Gone; 3]);
        // 4.4: 128 was "may be killed", 2048 "preempted".
        let states = task_states(r#"2048-1) ? __print_flags(x, "|", { 1, "S"} , { 2, "D" }, { 128, "K" }) : "R""#);
        let old = Formats { states, ..new };
        assert_eq!(
            [1, 2, 130, 2048].map(|bits| old.task_state(bits)),
            [TaskState::Sleeping, TaskState::Uninterruptible, TaskState::Uninterruptible, TaskState::Runnable]
        );
    }

    #[test]
    fn an_unreadable_format_is_an_error_with_its_file() {
        let root = tempfile::tempdir().unwrap();
        let write = |file: &str, text: &str| {
            let path = root.path().join("events").join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let failed = || Formats::read(root.path()).unwrap_err();
        assert!(failed().path.ends_with("header_page"));
        write("header_page", "field: u64 timestamp;\toffset:0;\tsize:8;\tsigned:0;\n");
        assert!(failed().source.to_string().contains("commit"));
        write("header_page", &fs::read_to_string(data("5.4/events/header_page")).unwrap());
        assert_eq!(failed().source.kind(), io::ErrorKind::NotFound);
        for text in ["", "ID: x\n", "ID: 70000\n", "ID: 7\nfield:int prev_pid;\toffset:8;\tsize:4;\tsigned:1;\n"] {
            write("sched/sched_switch/format", text);
            assert!(failed().path.ends_with("sched_switch/format"), "{text}");
        }
    }

    /// Checks that a page decodes without panic, in order, and to no more events than fit.
    fn check(formats: &Formats, bytes: &[u8]) {
        let events = decode(formats, bytes);
        assert!(events.len() <= 1 + bytes.len() / 4);
        assert!(events.is_sorted_by_key(|event| event.ns));
    }

    #[test]
    fn damaged_pages_neither_panic_nor_step_back() {
        let (bytes, _) = recorded();
        let kernels = [formats("6.18"), formats("5.4")];
        let changes = proptest::collection::vec((0..bytes.len(), any::<u8>()), 0..20);
        proptest!(|(start in 0..bytes.len(), length in 0..=4096_usize, changes in changes)| {
            let mut bytes = bytes.clone();
            for (at, byte) in changes {
                bytes[at] = byte;
            }
            let start = if length % 2 == 0 { start / 4096 * 4096 } else { start };
            kernels.iter().for_each(|formats| check(formats, &bytes[start..bytes.len().min(start + length)]));
        });
        proptest!(|(mut bytes in proptest::collection::vec(any::<u8>(), 0..600), length in 0..2_u8)| {
            // Half of the pages have a length that lets all their bytes be decoded.
            if let (0, Some(commit)) = (length, bytes.get_mut(8..16)) {
                commit.copy_from_slice(&1000_u64.to_le_bytes());
            }
            kernels.iter().for_each(|formats| check(formats, &bytes));
        });
    }

    #[test]
    fn damaged_formats_do_not_panic() {
        let line = "field:__data_loc char[] name;\toffset:12;\tsize:4;\tsigned:0;";
        proptest!(|(at in 0..line.len(), with in "\\PC{0,8}", offset: usize, size in 0..20_usize, signed: bool)| {
            let _ = Field::parse(&[&line[..at], &with, &line[at..]].concat());
            let _ = task_states(&with);
            for field in [false, true].map(|indirect| Field { offset: offset >> (size * 3), size, signed, indirect }) {
                let _ = (field.number::<i32>(&[255; 40]), field.text(&[255; 40]));
            }
        });
    }
}
