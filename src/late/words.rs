//! Late ticks in words: for a terminal and for captions.
//!
//! Must not name a cause that the report does not have.

use super::model::{LateKind, LateReport, LateTick, Pattern, Source, TickOfRole};
use std::fmt::Write;

/// The unit of delays on a terminal.
pub const ASCII_US: &str = "us";
/// The largest number of columns of [`late_table`].
const COLUMNS: usize = 80;
/// The part of a delay from which on its unknown rest is shown.
const UNKNOWN_SHARE: f64 = 0.05;
/// The indentation of a cause below its tick.
const INDENT: usize = 2;

/// Returns the late ticks by cause as a table: the cause with the largest sum first, at most `lines` lines of 80 columns. Empty if no
/// tick was late.
pub fn late_table(report: &LateReport, lines: usize) -> String {
    let rows = cause_rows(report, lines.saturating_sub(1));
    if rows.is_empty() {
        return String::new();
    }
    let head = ["late ticks by cause", "ticks", "worst us", "sum us"].map(str::to_owned);
    let width = |column: usize| {
        let cells = [&head].into_iter().chain(&rows).map(|row| row[column].chars().count());
        cells.max().unwrap_or(0)
    };
    let [ticks, worst, sum] = [1, 2, 3].map(width);
    let room = COLUMNS.saturating_sub(ticks + worst + sum + 6);
    let names = width(0).min(room);
    let mut text = String::new();
    for [name, cells @ ..] in [&head].into_iter().chain(&rows) {
        let [a, b, c] = cells;
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{:<names$}  {a:>ticks$}  {b:>worst$}  {c:>sum$}", shortened(name, names));
    }
    text
}

/// Returns a row of cause, ticks, worst and sum for each cause. If there are more than `most`, the last row sums up the rest.
pub fn cause_rows(report: &LateReport, most: usize) -> Vec<[String; 4]> {
    let shown = if report.causes.len() > most { most.saturating_sub(1) } else { report.causes.len() };
    let (first, rest) = report.causes.split_at(shown);
    let row = |name: String, ticks: u64, worst: f64, sum: f64| [name, ticks.to_string(), us(worst), us(sum)];
    let mut rows: Vec<_> =
        first.iter().map(|total| row(total.cause.clone(), total.ticks, total.worst_us, total.sum_us)).collect();
    if !rest.is_empty() {
        let ticks = rest.iter().fold(0_u64, |sum, total| sum.saturating_add(total.ticks));
        let worst = rest.iter().map(|total| total.worst_us).fold(0.0, f64::max);
        rows.push(row(
            format!("{} more causes", rest.len()),
            ticks,
            worst,
            rest.iter().map(|total| total.sum_us).sum(),
        ));
    }
    rows
}

/// Returns the first line about a run: the number of late ticks, the limit and the source of the causes.
pub fn header(report: &LateReport, unit: &str) -> String {
    let (counted, examined) = (report.counted, report.examined);
    let source = match (report.source, report.traced) {
        (Source::Counters, _) => "counters, which tell the kind of a cause".to_owned(),
        (Source::Kernel, Some(traced)) if traced < examined => {
            format!("the kernel's trace for {traced}, from counters for the others")
        }
        (Source::Kernel, _) => "the kernel's trace".to_owned(),
    };
    let number = if counted == examined { counted.to_string() } else { format!("{examined} of {counted}") };
    let part = match report.left_out() {
        0 => String::new(),
        left_out => format!("; {left_out} short ones left out of this file"),
    };
    let steal = |(core, ms): (&usize, &f64)| format!("; the hypervisor took {} ms of core {core}", plain(*ms));
    let steal: String = report.steal_ms.iter().map(steal).collect();
    format!("{number} late ticks examined{part}; limit {} {unit}; causes from {source}{steal}", plain(report.late_us))
}

/// Breaks a line between its parts, which end with `; `, into lines of at most 80 columns if no part is longer.
pub fn folded(line: &str) -> String {
    let mut lines: Vec<String> = Vec::new();
    for part in line.split("; ") {
        match lines.last_mut() {
            Some(line) if line.chars().count() + part.chars().count() + 3 <= COLUMNS => line.extend(["; ", part]),
            _ => lines.push(part.to_owned()),
        }
    }
    lines.join(";\n")
}

/// Returns late ticks with their chains of causes, one cause per line.
pub fn listing(report: &LateReport, ticks: &[&LateTick], unit: &str) -> String {
    let mut text = String::new();
    for late in ticks {
        let chain = report.chain(late);
        for (depth, late) in chain.ticks.iter().enumerate() {
            let indent = 2 * INDENT * depth;
            let _ = writeln!(text, "{:indent$}{}", "", title(late, unit));
            let indent = indent + INDENT;
            for (part, cause) in parts(late) {
                let _ = writeln!(text, "{:indent$}{:>8} {unit}  {cause}", "", us(part));
            }
        }
        if let Some(open) = chain.open {
            let indent = 2 * INDENT * chain.ticks.len();
            let _ = writeln!(text, "{:indent$}{}", "", end(report, open));
        }
    }
    text
}

/// Returns a late tick and its chain of causes as one sentence.
pub fn sentence(report: &LateReport, late: &LateTick, unit: &str) -> String {
    let chain = report.chain(late);
    let tick = |late: &&LateTick| {
        let causes: Vec<String> =
            parts(late).into_iter().map(|(part, cause)| format!("{cause} {} {unit}", us(part))).collect();
        format!("{}: {}", title(late, unit), causes.join(", "))
    };
    let ticks = chain.ticks.iter().map(tick).chain(chain.open.map(|open| end(report, open)));
    format!("{}.", ticks.collect::<Vec<_>>().join("; "))
}

/// Returns role, tick, time, kind and delay of a late tick.
pub fn title(late: &LateTick, unit: &str) -> String {
    let LateTick { role, tick, ticks, .. } = late;
    let which = match ticks {
        0 | 1 => format!("tick {tick}"),
        _ => format!("ticks {tick} to {}", tick.saturating_add(ticks - 1)),
    };
    let kind = match late.kind {
        LateKind::Late => "late",
        LateKind::Missed => "missed, late",
        LateKind::Starved => "starved, late",
    };
    format!("{role} {which} at {} s, {kind} by {} {unit}", plain(late.time_s), us(late.late_us))
}

/// Returns a period with which late ticks repeat, and a frequent reason for it.
pub fn pattern(pattern: &Pattern) -> String {
    let Pattern { cause, compared, period_ms, ticks, hint } = pattern;
    let hint = hint.as_ref().map_or(String::new(), |hint| format!(": {hint}"));
    format!("{cause}: {ticks} of {compared} late ticks every {} ms at the same phase{hint}", plain(*period_ms))
}

/// Returns the parts of a delay with their causes; an unknown rest only from 5 % on.
fn parts(late: &LateTick) -> Vec<(f64, String)> {
    let unknown_us = late.unknown_us();
    let mut parts: Vec<_> = late.known_causes().map(|cause| (cause.us, cause.to_string())).collect();
    if parts.is_empty() || unknown_us > UNKNOWN_SHARE * late.late_us {
        parts.push((unknown_us, "unknown".to_owned()));
    }
    parts
}

/// Returns the reason why a chain is not followed to this tick.
fn end(report: &LateReport, open: &TickOfRole) -> String {
    let TickOfRole { role, tick } = open;
    match report.find(role, *tick) {
        Some(_) => format!("{role} tick {tick}: the chain continues there"),
        None => format!("{role} tick {tick}: not examined"),
    }
}

/// Formats a delay in µs.
pub fn us(value: f64) -> String {
    if value.abs() < 1e7 { format!("{value:.1}") } else { format!("{value:.3e}") }
}

/// Formats a number without trailing zeros.
fn plain(value: f64) -> String {
    if value.abs() < 1e9 {
        let text = format!("{value:.6}");
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    format!("{value:.3e}")
}

/// Shortens a text to a number of letters.
fn shortened(text: &str, letters: usize) -> String {
    if text.chars().count() <= letters {
        return text.to_owned();
    }
    text.chars().take(letters.saturating_sub(3)).chain("...".chars()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::{Cause, CauseKind, CauseTotal, fixture};

    fn total(index: u64, name: &str) -> CauseTotal {
        let (worst_us, sum_us) = (10.0 * index as f64, 100.0 * index as f64);
        CauseTotal {
            cause: format!("task \"{name}\""),
            kind: CauseKind::Task,
            name: name.into(),
            ticks: index,
            worst_us,
            sum_us,
        }
    }

    #[test]
    fn the_table_has_at_most_eight_lines_of_eighty_columns_and_keeps_the_sums() {
        let mut report = fixture::report();
        for (count, long) in [(0, 1), (1, 1), (7, 30), (8, 30), (20, 300), (3, 300)] {
            report.causes = (1..=count).map(|index| total(index, &"x".repeat(long))).collect();
            let table = late_table(&report, 8);
            let lines: Vec<&str> = table.lines().collect();
            assert_eq!(lines.len() as u64, if count == 0 { 0 } else { (count + 1).min(8) });
            assert!(lines.iter().all(|line| line.chars().count() <= COLUMNS), "{table}");
            let number = |line: &&str, place: usize| line.split_whitespace().rev().nth(place)?.parse::<f64>().ok();
            let sum = |place| lines.iter().filter_map(|line| number(line, place)).sum::<f64>();
            let all = (count * (count + 1) / 2) as f64;
            assert_eq!((sum(0), sum(2)), (100.0 * all, all), "{table}");
        }
        assert!(late_table(&fixture::report(), 8).lines().last().unwrap().starts_with("6 more causes"));
        report.causes = vec![CauseTotal { worst_us: f64::MAX, sum_us: f64::MAX, ticks: u64::MAX, ..total(1, "x") }; 9];
        let table = late_table(&report, 8);
        assert!(table.lines().all(|line| line.len() <= COLUMNS) && table.lines().count() == 8, "{table}");
    }

    #[test]
    fn a_tick_is_listed_with_its_causes_down_to_the_first_late_tick() {
        let report = fixture::report();
        let text = listing(&report, &[report.find("controller", 755).unwrap()], "us");
        let lines: Vec<&str> = text.lines().map(str::trim_start).collect();
        let expected = [
            "controller tick 755 at 0.755 s, late by 425.4 us",
            "420.0 us  late input from observer",
            "observer tick 755 at 0.755 s, late by 422.1 us",
            "420.0 us  late input from leader",
            "leader tick 755 at 0.755 s, late by 420.0 us",
            "420.0 us  core taken by the hypervisor",
        ];
        assert_eq!(lines, expected);
        let indents = text.lines().map(|line| line.len() - line.trim_start().len()).step_by(2);
        assert_eq!(indents.collect::<Vec<_>>(), [0, 4, 8]);
    }

    #[test]
    fn an_unknown_part_is_listed_from_five_percent_on() {
        let report = fixture::report();
        let listed = |ns: u64| {
            let late = fixture::late("leader", 3, 100.0, vec![Cause::new(CauseKind::Step, "", ns)]);
            listing(&report, &[&late], "us")
        };
        assert!(!listed(95_100).contains("unknown") && listed(94_000).contains(" 6.0 us  unknown"));
        let none = listing(&report, &[&fixture::late("leader", 3, 100.0, vec![])], "us");
        assert!(none.contains("100.0 us  unknown"));
    }

    #[test]
    fn numbers_at_the_end_of_their_range_have_words() {
        let mut report = fixture::report();
        let huge = LateTick { ticks: u64::MAX, time_s: f64::MAX, ..fixture::late("a", u64::MAX, f64::MAX, vec![]) };
        report.ticks = vec![LateTick { ticks: 0, ..huge.clone() }, huge];
        report.late_us = f64::MIN;
        let text = listing(&report, &report.worst_first(), "us");
        assert!(text.lines().all(|line| line.len() < 120), "{text}");
        assert!(header(&report, "us").len() < 120);
        report.traced = Some(7);
        report.steal_ms = [(0, 20.0), (1, 70.0)].into();
        let line = header(&report, "us");
        let text = folded(&line);
        assert!(text.lines().count() > 2 && text.lines().all(|line| line.chars().count() <= COLUMNS), "{text}");
        assert_eq!(text.replace('\n', " "), line);
    }
}
