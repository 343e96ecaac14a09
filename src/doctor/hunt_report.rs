//! Options and result of a hunt: the lateness of each core, and its late wakes by cause.

use super::probe::Wakes;
use crate::late::{ASCII_US, LateReport, LateTick, SCHEMA as LATE_SCHEMA, Source, TracerCost};
use crate::late::{folded, header, late_table, pattern, us};
use crate::telemetry::{Grant, MachineInfo, Percentiles};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// Layout version of the report.
const SCHEMA: &str = "corotate/hunt/v1";
/// The scenario's name in the report of the late wakes.
const SCENARIO: &str = "doctor --hunt";
/// The largest number of lines of the table of causes.
const CAUSE_LINES: usize = 20;

/// Options of a hunt.
#[derive(Debug, Clone, Copy)]
pub struct HuntOptions {
    /// The duration, s.
    pub seconds: u32,
    /// The number of wakes per second.
    pub rate_hz: u32,
}

impl HuntOptions {
    /// Returns the period, ns.
    pub fn period_ns(&self) -> u64 {
        1_000_000_000 / u64::from(self.rate_hz)
    }

    /// Returns the number of ticks.
    pub fn ticks(&self) -> u64 {
        u64::from(self.seconds) * u64::from(self.rate_hz)
    }
}

/// The lateness of the wakes on a core.
#[derive(Debug, Clone, Serialize)]
pub struct CoreLateness {
    /// The core.
    pub core: usize,
    /// The number of wakes.
    pub wakes: u64,
    /// The number of ticks without a wake of their own, because the wake before was a period late or more.
    pub missed: u64,
    /// The number of ticks beyond the limit.
    pub late: u64,
    /// The lateness at every tick, missed ones included.
    pub lateness: Percentiles,
}

impl CoreLateness {
    /// Returns the figures of a probe.
    pub fn new(core: usize, counts: &Wakes) -> Self {
        let Wakes { wakes, missed, late, ref lateness } = *counts;
        Self { core, wakes, missed, late, lateness: lateness.percentiles() }
    }
}

/// The measurements of a hunt.
pub struct Measured {
    /// The first due time, ns.
    pub epoch_ns: u64,
    /// The limit beyond which a wake is late, ns.
    pub late_ns: u64,
    /// The cores.
    pub cores: Vec<CoreLateness>,
    /// The requested privileges.
    pub grants: Vec<Grant>,
    /// The examined late wakes, in any order.
    pub ticks: Vec<LateTick>,
    /// The number of those whose causes are from the kernel's trace.
    pub traced: u64,
    /// The costs of the trace, if there was one.
    pub cost: Option<TracerCost>,
    /// The reason why there is no trace, with the remedy.
    pub note: Option<String>,
}

/// The whole report.
#[derive(Debug, Clone, Serialize)]
pub struct HuntReport {
    schema: &'static str,
    host: MachineInfo,
    /// The number of wakes per second.
    pub rate_hz: u32,
    /// The duration that was asked for, s.
    pub seconds: u32,
    /// The requested privileges, granted or not.
    pub grants: Vec<Grant>,
    /// The cores.
    pub cores: Vec<CoreLateness>,
    /// The late wakes; the roles are called `core 0`, `core 1` and so on.
    pub late: LateReport,
}

impl HuntReport {
    /// Creates the report.
    pub fn new(options: &HuntOptions, measured: Measured) -> Self {
        let Measured { epoch_ns, late_ns, cores, grants, mut ticks, traced, cost, note } = measured;
        ticks.sort_by(|a, b| a.tick.cmp(&b.tick).then_with(|| a.role.cmp(&b.role)));
        let mut late = LateReport {
            schema: LATE_SCHEMA.to_owned(),
            run: None,
            scenario: SCENARIO.to_owned(),
            epoch_ns,
            period_us: options.period_ns() as f64 / 1e3,
            late_us: late_ns as f64 / 1e3,
            source: if cost.is_some() { Source::Kernel } else { Source::Counters },
            note,
            counted: cores.iter().map(|core| core.late).sum(),
            examined: ticks.iter().map(|late| late.ticks).sum(),
            traced: Some(traced),
            ticks,
            causes: Vec::new(),
            patterns: Vec::new(),
            steal_ms: BTreeMap::new(),
            tracer: cost,
        };
        late.summarize();
        let HuntOptions { seconds, rate_hz } = *options;
        Self { schema: SCHEMA, host: MachineInfo::local(), rate_hz, seconds, grants, cores, late }
    }

    /// Returns the report as one line of JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a report of plain values is JSON") + "\n"
    }

    /// Returns the granted privileges in words, and a line for each that was refused. A granted core is not named.
    fn privileges(&self) -> (String, Vec<String>) {
        let words = |grant: &Grant| format!("{} {}", grant.privilege, grant.asked);
        let granted = self.grants.iter().filter(|grant| grant.granted && grant.privilege != "core");
        let granted: Vec<String> = granted.map(words).collect();
        let refused = self.grants.iter().filter(|grant| !grant.granted);
        let refused = refused.map(|grant| format!("not granted: {}: {}", words(grant), grant.reason)).collect();
        let has_priority = self.grants.iter().any(|grant| grant.granted && grant.privilege == "SCHED_FIFO");
        let ordinary = (!has_priority).then(|| "ordinary priority".to_owned());
        (ordinary.into_iter().chain(granted).collect::<Vec<_>>().join(", "), refused)
    }
}

/// Writes a row per core, the causes of the late wakes and the periods with which they repeat.
impl fmt::Display for HuntReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (granted, refused) = self.privileges();
        writeln!(f, "{}, {}", self.host.cpu, self.host.kernel)?;
        writeln!(f, "a probe per core wakes {} times per second and does not spin; {granted}", self.rate_hz)?;
        refused.iter().try_for_each(|line| writeln!(f, "{line}"))?;
        let row = |f: &mut fmt::Formatter<'_>, [core, wakes, missed, late, p50, p99, p999, max]: [String; 8]| {
            writeln!(f, "{core:<8} {wakes:>9} {missed:>7} {late:>7} {p50:>8} {p99:>8} {p999:>9} {max:>11}")
        };
        writeln!(f)?;
        row(f, ["lateness", "wakes", "missed", "late", "p50 us", "p99 us", "p99.9 us", "max us"].map(str::to_owned))?;
        for CoreLateness { core, wakes, missed, late, lateness } in &self.cores {
            let figures = [lateness.p50_us, lateness.p99_us, lateness.p999_us, lateness.max_us].map(us);
            let [p50, p99, p999, max] = figures;
            let counts = [wakes, missed, late].map(u64::to_string);
            let [wakes, missed, late] = counts;
            row(f, [format!("core {core}"), wakes, missed, late, p50, p99, p999, max])?;
        }
        writeln!(f)?;
        if self.late.counted > 0 {
            writeln!(f, "{}", late_table(&self.late, CAUSE_LINES))?;
            self.late.patterns.iter().try_for_each(|found| writeln!(f, "{}", pattern(found)))?;
        }
        writeln!(f, "{}", folded(&header(&self.late, ASCII_US)))?;
        self.late.note.iter().try_for_each(|note| writeln!(f, "note: {note}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::{Cause, CauseKind, LateKind};

    const OPTIONS: HuntOptions = HuntOptions { seconds: 10, rate_hz: 1000 };

    fn late(core: usize, tick: u64, cause: Cause) -> LateTick {
        let (role, late_us) = (format!("core {core}"), cause.us);
        let (time_s, causes) = (tick as f64 / 1e3, vec![cause]);
        let (kind, caused_by, slices) = (LateKind::Late, None, Vec::new());
        LateTick { role, tick, ticks: 1, kind, time_s, late_us, causes, caused_by, slices }
    }

    fn grant(privilege: &str, asked: &str, granted: bool) -> Grant {
        let reason = if granted { "" } else { "Operation not permitted; grant CAP_SYS_NICE" };
        Grant { privilege: privilege.to_owned(), asked: asked.to_owned(), granted, reason: reason.to_owned() }
    }

    /// A hog on core 1, and core 0 taken every 100 ms.
    fn measured(granted: bool) -> Measured {
        let hog = Cause { tid: Some(47), priority: Some(4), ..Cause::new(CauseKind::Task, "hog", 500_000) };
        let taken = Cause::new(CauseKind::CoreTaken, "hypervisor", 300_000);
        let taken = (0..20).map(|index| late(0, 55 + 100 * (19 - index), taken.clone()));
        let counts = |core| {
            let mut wakes = Wakes { wakes: 9_999, missed: 1, late: 21, ..Wakes::default() };
            (0..10_000).for_each(|_| wakes.lateness.record(0, 3_000));
            CoreLateness::new(core, &wakes)
        };
        Measured {
            epoch_ns: 7,
            late_ns: 100_000,
            cores: vec![counts(0), counts(1)],
            grants: vec![grant("SCHED_FIFO", "80", granted), grant("core", "0", true), grant("core", "1", true)],
            ticks: taken.chain([late(1, 400, hog)]).collect(),
            traced: if granted { 21 } else { 0 },
            cost: granted.then_some(TracerCost { cpu_s: 0.1, events: 5, overruns: 0 }),
            note: (!granted).then(|| "no kernel trace: run as root".to_owned()),
        }
    }

    #[test]
    fn cores_causes_and_periods_are_listed() {
        let report = HuntReport::new(&OPTIONS, measured(true));
        let text = report.to_string();
        let has = |line: &str| assert!(text.lines().any(|found| found.starts_with(line)), "{line}: {text}");
        has("a probe per core wakes 1000 times per second and does not spin; SCHED_FIFO 80");
        has("core 1        9999       1      21      3.0      3.0       3.0         3.0");
        has("core taken by the hypervisor                      20     300.0  6000.0");
        has("task \"hog\" (thread 47, real-time priority 95)      1     500.0   500.0");
        has("core taken, or timer late: 20 of 20 late ticks every 100 ms");
        has("21 of 42 late ticks examined; limit 100 us; causes from the kernel's trace");
        let row = text.lines().find(|line| line.starts_with("lateness")).unwrap();
        assert!(row.len() <= 80 && row.ends_with("max us"), "{row}");
        let json: serde_json::Value = serde_json::from_str(&report.to_json()).unwrap();
        assert_eq!((&json["schema"], &json["late"]["source"]), (&SCHEMA.into(), &"kernel".into()));
        assert_eq!((&json["cores"][1]["core"], &json["cores"][1]["lateness"]["count"]), (&1.into(), &10_000.into()));
        let text = HuntReport::new(&OPTIONS, Measured { traced: 15, ..measured(true) }).to_string();
        assert!(text.contains("causes from the kernel's trace for 15, from counters for the others\n"), "{text}");
        // A reader of `late.json` reads it.
        let read = LateReport::parse(json["late"].to_string().as_bytes()).unwrap();
        assert!(read.ticks.is_sorted_by_key(|late| late.tick) && read.ticks.len() == 21 && read.epoch_ns == 7);
    }

    #[test]
    fn what_is_not_granted_is_printed_with_the_remedy() {
        let text = HuntReport::new(&OPTIONS, measured(false)).to_string();
        for part in ["does not spin; ordinary priority\n", "not granted: SCHED_FIFO 80: ", "grant CAP_SYS_NICE\n"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(text.ends_with("which tell the kind of a cause\nnote: no kernel trace: run as root\n"), "{text}");
        let quiet = Measured { cores: Vec::new(), ticks: Vec::new(), traced: 0, ..measured(true) };
        let text = HuntReport::new(&OPTIONS, quiet).to_string();
        assert!(text.ends_with("max us\n\n0 late ticks examined; limit 100 us; causes from the kernel's trace\n"));
    }
}
