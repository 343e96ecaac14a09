//! Late ticks as a Chrome trace, which <https://ui.perfetto.dev> opens.
//!
//! All times are µs after the due time of the first tick. Must not keep samples in memory: a recording may be larger.

use super::model::{LateReport, LateTick, SliceKind};
use super::words::title;
use serde_json::{Value, json};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::io::{self, Write};

/// The processes of the trace, under which its tracks are.
const ROLES: u32 = 1;
const CORES: u32 = 2;

/// A sample as a mark on the track of its role.
#[derive(Debug, Clone, Copy)]
pub struct SampleMark<'a> {
    /// The role that sent it.
    pub role: &'a str,
    /// The name of the signal.
    pub signal: &'a str,
    /// The tick.
    pub tick: u64,
    /// The time at which it was sent, ns after the due time of the first tick.
    pub sent_ns: i64,
}

/// A writer of a Chrome trace.
///
/// ```
/// use corotate::late::{LateReport, Perfetto, SampleMark};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let report = LateReport::parse(br#"{
///     "schema": "corotate/late/v1", "run": null, "scenario": "rigid-pair", "period_us": 1000, "late_us": 100, "source": "counters",
///     "counted": 0, "examined": 0, "ticks": [], "causes": [], "patterns": []
/// }"#)?;
/// let mut trace = Perfetto::new(Vec::new(), &report)?;
/// trace.sample(&SampleMark { role: "leader", signal: "leader/measurement", tick: 0, sent_ns: 1_500 })?;
/// let text = String::from_utf8(trace.finish()?)?;
/// assert!(text.contains(r#""ts":1.5"#));
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Perfetto<W> {
    out: W,
    events: u64,
    /// The thread identifier of each track of a role: its main one, and one for each late tick that overlaps with others.
    roles: BTreeMap<(String, usize), u32>,
}

impl<W: Write> Perfetto<W> {
    /// Begins a trace and writes the late ticks of a report: a slice from due time to the end of the delay on the track of the role,
    /// and the slices of the cores around the worst ones.
    ///
    /// # Errors
    /// The error of the writer.
    pub fn new(mut out: W, report: &LateReport) -> io::Result<Self> {
        let about = json!({ "scenario": report.scenario, "run": report.run, "late_us": report.late_us });
        write!(out, "{{\"displayTimeUnit\":\"ns\",\"otherData\":{about},\"traceEvents\":[")?;
        let mut trace = Self { out, events: 0, roles: BTreeMap::new() };
        trace.name("process_name", ROLES, 0, "roles")?;
        trace.name("process_name", CORES, 0, "cores")?;
        trace.late_ticks(report)?;
        trace.cores(report)?;
        Ok(trace)
    }

    /// Writes a sample as an instant.
    ///
    /// # Errors
    /// The error of the writer.
    pub fn sample(&mut self, sample: &SampleMark<'_>) -> io::Result<()> {
        let thread = self.track(sample.role, 0)?;
        self.event(&json!({
            "ph": "i", "s": "t", "cat": "sample", "name": sample.signal, "pid": ROLES, "tid": thread, "ts": us(sample.sent_ns),
            "args": { "tick": sample.tick },
        }))
    }

    /// Ends the trace and returns the writer.
    ///
    /// # Errors
    /// The error of the writer.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.write_all(b"\n]}\n")?;
        self.out.flush()?;
        Ok(self.out)
    }

    fn late_ticks(&mut self, report: &LateReport) -> io::Result<()> {
        let mut ticks: Vec<(i64, i64, &LateTick)> = report
            .ticks
            .iter()
            .map(|late| (due_ns(late), due_ns(late).saturating_add(ns(late.late_us.max(0.0))), late))
            .collect();
        ticks.sort_by_key(|(due, end, _)| (*due, *end));
        // Slices of one track must not overlap, so each late tick takes the first track that is free again.
        let mut ends: BTreeMap<&str, Vec<i64>> = BTreeMap::new();
        for (due, end, late) in ticks {
            let ends = ends.entry(&late.role).or_default();
            let lane = ends.iter().position(|free| *free <= due).unwrap_or(ends.len());
            ends.resize(ends.len().max(lane + 1), end);
            ends[lane] = end;
            let thread = self.track(&late.role, lane)?;
            let causes = late.causes.iter().map(|cause| json!({ "cause": cause.to_string(), "us": cause.us }));
            let kind: &str = late.kind.into();
            let name = late.main_cause().map_or("unknown".to_owned(), ToString::to_string);
            self.event(&json!({
                "ph": "X", "cat": kind, "name": name, "pid": ROLES, "tid": thread, "ts": us(due), "dur": us(end.saturating_sub(due)),
                "args": {
                    "about": title(late, "us"), "tick": late.tick, "ticks": late.ticks, "kind": kind, "late_us": late.late_us,
                    "causes": causes.collect::<Vec<_>>(), "unknown_us": late.unknown_us(), "caused_by": late.caused_by,
                },
            }))?;
        }
        Ok(())
    }

    fn cores(&mut self, report: &LateReport) -> io::Result<()> {
        let slices = core_slices(report);
        let mut threads: BTreeMap<usize, u32> = BTreeMap::new();
        for core in slices.iter().map(|slice| slice.core) {
            let next = threads.len() as u32 + 1;
            threads.entry(core).or_insert(next);
        }
        for (core, thread) in &threads {
            self.name("thread_name", CORES, *thread, &format!("core {core}"))?;
        }
        for CoreSlice { core, from_ns, to_ns, kind, name } in slices {
            self.event(&json!({
                "ph": "X", "cat": kind, "name": name, "pid": CORES, "tid": threads[&core], "ts": us(from_ns),
                "dur": us(to_ns.saturating_sub(from_ns)),
            }))?;
        }
        Ok(())
    }

    /// Returns the thread identifier of a role's track, which is named at its first use.
    fn track(&mut self, role: &str, lane: usize) -> io::Result<u32> {
        if let Some(thread) = self.roles.get(&(role.to_owned(), lane)) {
            return Ok(*thread);
        }
        let thread = self.roles.len() as u32 + 1;
        self.roles.insert((role.to_owned(), lane), thread);
        let name = if lane == 0 { role.to_owned() } else { format!("{role}, overlapping {lane}") };
        self.name("thread_name", ROLES, thread, &name)?;
        Ok(thread)
    }

    fn name(&mut self, what: &str, process: u32, thread: u32, name: &str) -> io::Result<()> {
        self.event(&json!({ "ph": "M", "name": what, "pid": process, "tid": thread, "args": { "name": name } }))
    }

    fn event(&mut self, event: &Value) -> io::Result<()> {
        let separator = if self.events == 0 { "\n" } else { ",\n" };
        self.events += 1;
        write!(self.out, "{separator}{event}")
    }
}

/// A slice of a core on the time axis of the trace.
#[derive(Debug, Clone, Copy)]
struct CoreSlice<'a> {
    core: usize,
    from_ns: i64,
    to_ns: i64,
    kind: SliceKind,
    name: &'a str,
}

/// Returns the slices of all cores. Those that several late ticks have are merged; the rest is disjoint or nested.
fn core_slices(report: &LateReport) -> Vec<CoreSlice<'_>> {
    let mut slices: Vec<CoreSlice<'_>> = Vec::new();
    for late in &report.ticks {
        let at = |time_us: f64| due_ns(late).saturating_add(ns(time_us));
        slices.extend(late.slices.iter().map(|slice| CoreSlice {
            core: slice.core,
            from_ns: at(slice.from_us),
            to_ns: at(slice.to_us),
            kind: slice.kind,
            name: &slice.name,
        }));
    }
    slices.retain(|slice| slice.to_ns > slice.from_ns);
    nested(merged(slices))
}

/// Merges slices of one core, kind and name that overlap or touch.
fn merged(mut slices: Vec<CoreSlice<'_>>) -> Vec<CoreSlice<'_>> {
    slices.sort_by_key(|slice| (slice.core, slice.from_ns, Reverse(slice.to_ns)));
    let mut last: BTreeMap<(usize, &str, &str), usize> = BTreeMap::new();
    let mut merged: Vec<CoreSlice<'_>> = Vec::new();
    for slice in slices {
        let key = (slice.core, slice.kind.into(), slice.name);
        match last.get(&key).map(|index| &mut merged[*index]) {
            Some(before) if slice.from_ns <= before.to_ns => before.to_ns = before.to_ns.max(slice.to_ns),
            _ => {
                last.insert(key, merged.len());
                merged.push(slice);
            }
        }
    }
    merged
}

/// Shortens slices that overlap partly with an earlier one of their core, because a viewer drops those.
fn nested(slices: Vec<CoreSlice<'_>>) -> Vec<CoreSlice<'_>> {
    // Core, begin, end and index: the next one is the earliest and, of several, the longest.
    type Entry = Reverse<(usize, i64, Reverse<i64>, usize)>;
    let mut waiting: BinaryHeap<Entry> = BinaryHeap::new();
    let entry = |index: usize, slice: &CoreSlice<'_>| Reverse((slice.core, slice.from_ns, Reverse(slice.to_ns), index));
    waiting.extend(slices.iter().enumerate().map(|(index, slice)| entry(index, slice)));
    let (mut open, mut done): (Vec<CoreSlice<'_>>, Vec<CoreSlice<'_>>) = (Vec::new(), Vec::new());
    while let Some(Reverse((core, from_ns, _, index))) = waiting.pop() {
        let slice = CoreSlice { from_ns, ..slices[index] };
        while open.last().is_some_and(|outer| outer.core != core || outer.to_ns <= from_ns) {
            open.pop();
        }
        match open.last() {
            Some(outer) if slice.to_ns > outer.to_ns => {
                waiting.push(entry(index, &CoreSlice { from_ns: outer.to_ns, ..slice }));
            }
            _ => {
                open.push(slice);
                done.push(slice);
            }
        }
    }
    done
}

/// Returns the due time of a tick, ns after that of the first one.
fn due_ns(late: &LateTick) -> i64 {
    (late.time_s * 1e9).round() as i64
}

/// Converts µs to ns. Times beyond the range are at its end.
fn ns(us: f64) -> i64 {
    (us * 1e3).round() as i64
}

/// Converts ns to the unit of the trace.
fn us(ns: i64) -> f64 {
    ns as f64 / 1e3
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::{Slice, fixture};

    fn events(report: &LateReport, samples: &[SampleMark<'_>]) -> Vec<Value> {
        let mut trace = Perfetto::new(Vec::new(), report).unwrap();
        samples.iter().for_each(|sample| trace.sample(sample).unwrap());
        let mut object: Value = serde_json::from_slice(&trace.finish().unwrap()).unwrap();
        let Value::Array(events) = object["traceEvents"].take() else { panic!("{object}") };
        events
    }

    /// Returns begin, end and name of the slices on each track.
    fn tracks(events: &[Value], process: u32) -> BTreeMap<u64, Vec<(f64, f64, &str)>> {
        let mut tracks: BTreeMap<u64, Vec<_>> = BTreeMap::new();
        for event in events.iter().filter(|event| event["ph"] == "X" && event["pid"] == process) {
            let (from, long) = (event["ts"].as_f64().unwrap(), event["dur"].as_f64().unwrap());
            assert!(long >= 0.0, "{event}");
            let slice = (from, from + long, event["name"].as_str().unwrap());
            tracks.entry(event["tid"].as_u64().unwrap()).or_default().push(slice);
        }
        tracks
    }

    fn assert_nested(tracks: &BTreeMap<u64, Vec<(f64, f64, &str)>>) {
        for slices in tracks.values() {
            for (index, a) in slices.iter().enumerate() {
                for b in &slices[index + 1..] {
                    let disjoint = a.1 <= b.0 + 1e-4 || b.1 <= a.0 + 1e-4;
                    let inside = |a: &(f64, f64, &str), b: &(f64, f64, &str)| a.0 >= b.0 - 1e-4 && a.1 <= b.1 + 1e-4;
                    assert!(disjoint || inside(a, b) || inside(b, a), "{a:?} {b:?}");
                }
            }
        }
    }

    #[test]
    fn late_ticks_cores_and_samples_are_on_one_axis() {
        let report = fixture::report();
        let sample = SampleMark { role: "leader", signal: "leader/truth", tick: 755, sent_ns: 755_420_003 };
        let events = events(&report, &[sample, SampleMark { role: "scorer", ..sample }]);
        let roles = tracks(&events, ROLES);
        assert_eq!(roles.values().map(Vec::len).sum::<usize>(), report.ticks.len());
        assert_nested(&roles);
        let leader = &roles[&thread(&events, ROLES, "leader")];
        assert!(leader.iter().any(|(from, to, name)| {
            (from - 755_000.0).abs() < 1e-6 && (to - 755_420.0).abs() < 1e-6 && *name == "core taken by the hypervisor"
        }));
        let instants: Vec<&Value> = events.iter().filter(|event| event["ph"] == "i").collect();
        assert_eq!((instants.len(), &instants[0]["ts"]), (2, &json!(755_420.003)));
        assert_eq!(instants[0]["tid"], thread(&events, ROLES, "leader"));
        assert_ne!(instants[1]["tid"], instants[0]["tid"]);

        let cores = tracks(&events, CORES);
        assert_nested(&cores);
        let stopped = report.worst_first()[0];
        let (from, to) = (stopped.time_s * 1e6 - 12.0, stopped.time_s * 1e6 + stopped.late_us - 4.0);
        let core = &cores[&thread(&events, CORES, "core 0")];
        let (first, last) = core.iter().fold((f64::MAX, f64::MIN), |(a, b), slice| (a.min(slice.0), b.max(slice.1)));
        assert!(core.iter().any(|slice| slice.0 <= from && slice.1 >= to && slice.2 == "follower"), "{from} {to}");
        assert!(first >= 0.0 && last < 10e6);
    }

    fn thread(events: &[Value], process: u32, name: &str) -> u64 {
        let named =
            |event: &&Value| event["name"] == "thread_name" && event["pid"] == process && event["args"]["name"] == name;
        events.iter().find(named).unwrap()["tid"].as_u64().unwrap()
    }

    #[test]
    fn overlapping_late_ticks_have_tracks_of_their_own() {
        let mut report = fixture::report();
        report.ticks = (0..6).map(|tick| fixture::late("leader", tick, 2500.0, Vec::new())).collect();
        let events = events(&report, &[]);
        let roles = tracks(&events, ROLES);
        assert_eq!(roles.values().map(Vec::len).collect::<Vec<_>>(), [2, 2, 2]);
        assert_nested(&roles);
    }

    #[test]
    fn slices_of_several_late_ticks_are_merged_and_nested() {
        let mut report = fixture::report();
        let slice =
            |name: &str, from_us, to_us| Slice { core: 3, kind: SliceKind::Task, name: name.into(), from_us, to_us };
        let slices = vec![slice("a", -10.0, 5.0), slice("b", 4.0, 20.0), slice("c", 4.5, 6.0), slice("d", 7.0, 8.0)];
        // The second window is 1 ms later: the same slices seen from there.
        let shifted = slices.iter().map(|slice| Slice {
            from_us: slice.from_us - 1000.0,
            to_us: slice.to_us - 1000.0,
            ..slice.clone()
        });
        let late = |tick, slices| LateTick { slices, ..fixture::late("leader", tick, 1.0, Vec::new()) };
        report.ticks = vec![late(1, slices.clone()), late(2, shifted.collect())];
        let events = events(&report, &[]);
        let cores = tracks(&events, CORES);
        assert_nested(&cores);
        let core = &cores[&thread(&events, CORES, "core 3")];
        assert_eq!(core.len(), 4, "{core:?}");
        assert_eq!(core.iter().map(|slice| slice.1 - slice.0).sum::<f64>().round(), 15.0 + 15.0 + 1.0 + 1.0);
    }

    #[test]
    fn absurd_times_are_written_as_numbers() {
        let mut report = fixture::report();
        let numbers = [f64::MIN, -1.0, 0.0, 1e18, f64::MAX];
        let slices = numbers.map(|from_us| {
            numbers.map(|to_us| Slice {
                core: usize::MAX,
                kind: SliceKind::Idle,
                name: "\u{1b}\"".into(),
                from_us,
                to_us,
            })
        });
        let ticks = numbers.map(|number| LateTick {
            time_s: number,
            late_us: number,
            slices: slices.concat(),
            ..fixture::late("leader", u64::MAX, 0.0, Vec::new())
        });
        report.ticks = ticks.to_vec();
        let events = events(&report, &[SampleMark { role: "", signal: "", tick: 0, sent_ns: i64::MIN }]);
        assert!(events.iter().all(|event| event["ph"] == "M" || event["ts"].is_number()));
        assert_nested(&tracks(&events, CORES));
    }
}
