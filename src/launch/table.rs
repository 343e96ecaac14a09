//! The results of a run on the screen.

use super::criteria::{exact, short};
use super::incident::Incident;
use super::outcome::{LinkCounters, State};
use super::summary::Summary;
use crate::analysis::digits;
use crate::hosts::{NetworkStatistics, Silence};
use crate::late::{late_table, pattern};
use crate::serial::LineCounters;
use crate::telemetry::{PaceReport, Percentiles};
use comfy_table::presets::NOTHING;
use comfy_table::{CellAlignment, Table};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Rows of results that are shown by default, so that all fits on a screen of 24 lines.
const RESULT_ROWS: usize = 8;
/// The end of a serial line's text if it had no fault.
const NO_FAULT: &str = "; no fault";
/// Lines of late ticks by cause, by default and with all.
const LATE_LINES: usize = 3;
const LATE_LINES_ALL: usize = 8;
/// Responses to steps that are shown by default.
const RESPONSES: usize = 4;
/// Incidents that are shown by default.
const INCIDENTS: usize = 4;

/// Returns the summary as text: results, latencies of estimate and control, counters, and what went wrong. An undisturbed run on one
/// host fits on a screen of 24 lines of 80 columns. `all` adds every stage, link, watchdog and privilege, up to 100 columns wide.
pub fn table(summary: &Summary, all: bool) -> String {
    let mut text = String::new();
    let seconds = summary.last_tick as f64 / summary.tick_hz;
    let _ = writeln!(
        text,
        "{}: {} at {} Hz, {} ticks ({seconds} s)",
        summary.scenario,
        summary.clock,
        summary.tick_hz,
        summary.last_tick + 1
    );
    let mut processes = BTreeMap::<&str, Vec<&str>>::new();
    summary.hosted.iter().for_each(|(role, host)| processes.entry(host).or_default().push(role));
    for (host, roles) in processes.into_iter().filter(|_| all) {
        let _ = writeln!(text, "one process: {}, {host}", roles.join(", "));
    }
    for note in &summary.notes {
        let _ = writeln!(text, "note: {note}");
    }
    results(summary, all, &mut text);
    responses(summary, if all { usize::MAX } else { RESPONSES }, &mut text);
    let shown = if all { usize::MAX } else { INCIDENTS };
    text.push_str(if summary.incidents.is_empty() { "" } else { "\n" });
    for incident in summary.incidents.iter().take(shown) {
        let _ = writeln!(text, "{incident}{}", times(incident));
    }
    if summary.incidents.len() > shown {
        let _ = writeln!(text, "{} more incidents: -v shows them", summary.incidents.len() - shown);
    }
    if !summary.latencies.is_empty() {
        let critical = Some(critical_latencies(summary)).filter(|rows| !all && !rows.is_empty());
        let rows = critical.unwrap_or_else(|| latencies(summary));
        let _ = writeln!(text, "\n{rows}{}", stamps_ahead(summary));
    }
    if let Some(late) = summary.late.as_ref().filter(|late| !late.causes.is_empty()) {
        let _ = write!(text, "\n{}", late_table(late, if all { LATE_LINES_ALL } else { LATE_LINES }));
        late.patterns.iter().filter(|_| all).for_each(|found| _ = writeln!(text, "{}", pattern(found)));
    }
    counters(summary, all, &mut text);
    watchdog(summary, all, &mut text);
    let lines = summary.lines.iter().map(|(body, counters)| line_words(body, counters));
    for line in lines.filter(|line| all || !line.ends_with(NO_FAULT)) {
        let _ = writeln!(text, "{line}");
    }
    for (role, pace) in &summary.pace {
        let _ = writeln!(text, "{}", pace_words(role, pace));
    }
    summary.hosts.iter().for_each(|summary| hosts(summary, &mut text));
    privileges(summary, all, &mut text);
    text.lines().flat_map(|line| [line.trim_end(), "\n"]).collect()
}

/// Returns the counters of a serial line in words: one line of traffic, one of faults.
pub fn line_words(body: &str, counters: &LineCounters) -> String {
    let well = format!(
        "line of {body}: {} frames and {} bytes sent, {} and {} received, {}",
        counters.frames_sent,
        counters.bytes_sent,
        counters.frames_received,
        counters.bytes_received,
        match counters.handshakes {
            1 => "1 handshake".to_owned(),
            count => format!("{count} handshakes"),
        },
    );
    let ill = [
        (counters.restarts, "restarts of the device with its body at the initial state"),
        (counters.crc_errors, "CRC errors"),
        (counters.malformed, "malformed blocks"),
        (counters.dropped_bytes, "bytes dropped"),
        (counters.resyncs, "resyncs"),
        (counters.sequence_gaps, "received frames lost"),
        (counters.repeats, "requests repeated"),
        (counters.unanswered, "ticks unanswered"),
        (counters.late, "late answers"),
        (counters.duplicates, "duplicate answers"),
        (counters.echoes, "echoes"),
        (counters.unsent, "frames not accepted by the line"),
        (counters.reopened, "reopenings"),
    ];
    let ill: Vec<String> =
        ill.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}")).collect();
    if ill.is_empty() { format!("{well}{NO_FAULT}") } else { format!("{well}\n  {}", ill.join(", ")) }
}

/// Returns the relation of a run's clock to the device that sets its pace, in words.
pub fn pace_words(role: &str, pace: &PaceReport) -> String {
    let us = |value: Option<f64>| value.map_or("-".to_owned(), |us| format!("{us:.1}"));
    let [p50, p99, max] = [pace.phase_error_p50_us, pace.phase_error_p99_us, pace.phase_error_max_us].map(us);
    let holdovers = match pace.holdovers {
        0 => String::new(),
        count => format!(", {count} holdovers ({:.1} s)", pace.holdover_s),
    };
    format!(
        "pace of {role}: {}, phase error p50 {p50}, p99 {p99}, max {max} us,\n  drift {:+.1} ppm, {} slips{holdovers}",
        pace.state, pace.drift_ppm, pace.slips
    )
}

fn results(summary: &Summary, all: bool, text: &mut String) {
    let dash = || "-".to_owned();
    let mut rows = Vec::new();
    for metric in &summary.score.metrics {
        let criterion = summary.criteria.iter().find(|criterion| criterion.name == format!("{}_max", metric.name));
        let holds = criterion.and_then(|criterion| criterion.holds);
        let row = [
            metric.name.clone(),
            if metric.last.is_nan() { dash() } else { format!("{:.2e}", metric.last) },
            metric.settled_max.map_or_else(dash, |value| format!("{value:.2e}")),
            criterion.map_or_else(dash, |criterion| exact(criterion.limit)),
            metric.settled_at_s.map_or_else(dash, |time| format!("{} s", digits(time))),
            verdict(holds),
        ];
        rows.push((holds, row));
    }
    let of_metric = |name: &str| summary.score.metrics.iter().any(|metric| name == format!("{}_max", metric.name));
    for criterion in summary.criteria.iter().filter(|criterion| !of_metric(&criterion.name)) {
        let value = criterion.value.map_or("not measured".to_owned(), short);
        let limit = exact(criterion.limit);
        rows.push((criterion.holds, [criterion.label(), value, dash(), limit, dash(), verdict(criterion.holds)]));
    }
    let hidden = if all { 0 } else { rows.len().saturating_sub(RESULT_ROWS) };
    if hidden > 0 {
        // Failures first, then what is not judged.
        rows.sort_by_key(|(holds, _)| holds.map_or(1, |holds| if holds { 2 } else { 0 }));
    }
    let mut table = plain(&["result", "at the end", "settled max", "limit", "since", "verdict"]);
    rows.iter().take(rows.len() - hidden).for_each(|(_, row)| _ = table.add_row(row));
    let _ = writeln!(text, "\n{table}");
    if hidden > 0 {
        let failing = rows[RESULT_ROWS..].iter().filter(|(holds, _)| *holds == Some(false)).count();
        let _ = writeln!(text, "{hidden} more results, {failing} of them FAIL: -v shows them");
    }
    if !all {
        return;
    }
    text.push('\n');
    for criterion in &summary.criteria {
        if let Some(reason) = &criterion.reason {
            let _ = writeln!(text, "{} is not judged: {reason}", criterion.name);
        }
    }
    if let Some(score) = summary.score.certificate {
        let (held, broken, judged) = (score.held, score.broken, score.held + score.broken);
        let kept = match broken {
            0 => format!("held at all of {judged} steps"),
            _ => format!("broken at {broken} of {judged} steps, held at {held}"),
        };
        let _ = writeln!(text, "bound on dV/dt {kept}, {} not judged", score.unjudged);
    }
    for (signal, statuses) in &summary.score.statuses {
        let statuses: Vec<String> = statuses.iter().map(|(name, ticks)| format!("{name} at {ticks}")).collect();
        let _ = writeln!(text, "{signal}: {} of {} ticks", statuses.join(", "), summary.last_tick + 1);
    }
}

/// Writes the responses to steps of inputs, and the number of all changes.
fn responses(summary: &Summary, most: usize, text: &mut String) {
    let responses = &summary.score.responses;
    if !responses.is_empty() {
        let mut table = plain(&["response to a step", "at", "rise", "over", "settled", "error", "command"]);
        for response in responses.iter().take(most) {
            let dash = || "-".to_owned();
            let seconds = |time_s: Option<f64>| time_s.map_or_else(dash, |time_s| format!("{} s", digits(time_s)));
            table.add_row([
                format!("{}[{}]", response.key, response.component),
                seconds(Some(response.time_s)),
                seconds(response.rise_time_s),
                response.overshoot.map_or_else(dash, |part| format!("{:.1} %", 100.0 * part)),
                seconds(response.settling_time_s),
                format!("{:.1e}", response.steady_state_error),
                response.command_max.map_or_else(dash, |command| format!("{command:.1e}")),
            ]);
        }
        let _ = writeln!(text, "\n{table}");
        if responses.len() > most {
            let _ = writeln!(text, "{} more responses: -v shows them", responses.len() - most);
        }
    }
    let received = summary.inputs.iter().filter(|change| change.received).count();
    if !summary.inputs.is_empty() {
        let scripted = summary.inputs.len() - received;
        let _ = writeln!(text, "changes of inputs: {scripted} of the scenario, {received} received");
    }
}

fn watchdog(summary: &Summary, all: bool, text: &mut String) {
    let Some(report) = &summary.watchdog else { return };
    for watched in report.watched.iter().filter(|watched| all || watched.breaches > 0) {
        let largest = watched.largest.map_or("not finite".to_owned(), |largest| format!("{largest:.2e}"));
        let (breaches, judged, max) = (watched.breaches, watched.judged, watched.max);
        let _ = write!(text, "watchdog, {}: {breaches} of {judged} beyond {max:e}", watched.quantity);
        let first = watched.first_tick.map_or(String::new(), |tick| format!(", first at tick {tick}"));
        let _ = writeln!(text, ", largest {largest}{first}");
    }
    if let Some(tick) = report.latched_at_tick {
        let _ = writeln!(text, "watchdog: safe command latched at tick {tick}");
    }
}

fn times(incident: &Incident) -> String {
    let time =
        |what: &str, seconds: Option<f64>| seconds.map_or(String::new(), |s| format!(", {what} after {} s", digits(s)));
    time("back", incident.outage_s) + &time("recovered", incident.recovery_s)
}

fn verdict(holds: Option<bool>) -> String {
    match holds {
        Some(true) => "holds",
        Some(false) => "FAILS",
        None => "-",
    }
    .to_owned()
}

/// The latencies of estimate and control, and the role with the largest p99 of its lateness, as a table.
fn critical_latencies(summary: &Summary) -> Table {
    let of_stage = |stage: &'static str| summary.latencies.iter().filter(move |row| row.stage == stage);
    let observes = |role: &str| role == "observer" || role.starts_with("observer-");
    let steps = of_stage("step").filter(|row| observes(&row.role) || row.role == "controller");
    let ages = of_stage("age").filter(|row| row.role == "controller");
    let lateness = summary.latencies.iter().filter(|row| row.stage == "lateness");
    let latest = lateness.max_by(|a, b| a.figures.p99_us.max(0.0).total_cmp(&b.figures.p99_us.max(0.0)));
    let mut rows = plain(&["latency, us", "p50", "p99", "p99.9", "max"]);
    for row in steps.chain(ages).chain(latest) {
        let figures = [row.figures.p50_us, row.figures.p99_us, row.figures.p999_us, row.figures.max_us];
        rows.add_row([format!("{} {}", row.role, row.stage)].into_iter().chain(figures.map(us)));
    }
    rows
}

fn latencies(summary: &Summary) -> Table {
    let mut rows = plain(&["latency, us", "stage", "count", "missed", "p50", "p90", "p99", "p99.9", "max"]);
    for stage in &summary.latencies {
        let f = &stage.figures;
        let mut row = vec![stage.role.clone(), stage.stage.clone(), f.count.to_string(), f.missed.to_string()];
        row.extend([f.p50_us, f.p90_us, f.p99_us, f.p999_us, f.max_us].map(us));
        rows.add_row(row);
    }
    rows
}

/// The reason why stages have no figures: a line per sender whose stamps lie ahead of this clock.
fn stamps_ahead(summary: &Summary) -> String {
    let mut ahead = BTreeMap::<&str, (f64, Vec<String>)>::new();
    for stage in &summary.latencies {
        if let Some(sender) = &stage.stamps_of {
            let (most_us, stages) = ahead.entry(sender).or_default();
            *most_us = most_us.max(stage.figures.ahead_max_us);
            stages.push(format!("{} of {} at {}", stage.stage, stage.role, stage.figures.ahead));
        }
    }
    let mut text = String::new();
    for (sender, (most_us, stages)) in ahead {
        let (most, stages) = (digits(most_us / 1e3), stages.join(", "));
        let _ =
            write!(text, "\nstamps of {sender} lie up to {most} ms ahead of this clock ({stages} ticks): not shown");
    }
    text
}

/// A figure of a latency; a dash if the stamps are not of one clock.
fn us(us: f64) -> String {
    if us.is_nan() { "-".to_owned() } else { format!("{us:.2}") }
}

fn counters(summary: &Summary, all: bool, text: &mut String) {
    let (books, state) = (&summary.books, &summary.state);
    let executed: u64 = books.roles.values().map(|ticks| ticks.executed).sum();
    let _ = writeln!(
        text,
        "\ncounters {}: {} roles, {executed} ticks, {} missed or starved, {}",
        if books.balanced { "balance" } else { "DO NOT BALANCE" },
        books.roles.len(),
        books.missed_ticks,
        match (summary.score.scored_ticks, summary.score.unscored_ticks) {
            (0, _) => "none scored".to_owned(),
            (_, 0) => "all scored".to_owned(),
            (_, unscored) => format!("{unscored} not scored"),
        },
    );
    let late = books.roles.iter().filter_map(|(role, ticks)| Some((role, ticks.late.filter(|late| *late > 0)?)));
    let late: Vec<(&String, u64)> = late.collect();
    if let (Some(late_us), true) = (summary.late_us, all && !late.is_empty()) {
        let by_role = late.iter().map(|(role, ticks)| format!("{role} {ticks}")).collect::<Vec<_>>().join(", ");
        let _ = writeln!(text, "executed ticks late by more than {} us: {by_role}", digits(late_us));
    }
    if books.injected_faults > 0 {
        let _ = writeln!(text, "scripted faults: acted {} times", books.injected_faults);
    }
    if books.rejected_samples > 0 {
        let reasons = if all { reasons(&books.rejected_by) } else { String::new() };
        let _ = writeln!(text, "{} samples rejected by their readers{reasons}", books.rejected_samples);
    }
    let met = |link: &&LinkCounters| link.published.is_none() || link.rejected + link.stale + link.void.1 > 0;
    for link in books.links.iter().filter(met).filter(|_| all) {
        let LinkCounters { service, reader, received, rejected, stale, void, .. } = link;
        let _ = write!(
            text,
            "  {service} at {reader}: {rejected} rejected{}, {stale} stale, {} void",
            reasons(&link.rejected_by),
            void.1
        );
        let _ = match link.published {
            Some(_) => writeln!(text),
            None => writeln!(text, " of {received} received"),
        };
    }
    for problem in &books.problems {
        let _ = writeln!(text, "  {problem}");
    }
    if !books.unbooked.is_empty() {
        let _ = writeln!(text, "no counters of {}: the readers count its signals", books.unbooked.join(", "));
    }
    let _ = match state.first_disturbed_tick {
        None => {
            let words =
                State::undisturbed_words(state.elapsed_ticks, summary.last_tick + 1, !books.unbooked.is_empty());
            writeln!(text, "state hash {} ({words})", state.hash)
        }
        Some(tick) => {
            writeln!(text, "state hash {}; {} before the disturbed tick {tick}", state.hash, state.clean_hash)
        }
    };
}

/// Returns the numbers of rejected samples by reason, in words.
pub(crate) fn reasons(rejected_by: &BTreeMap<String, u64>) -> String {
    let all: Vec<String> =
        rejected_by.iter().map(|(name, count)| format!("{count} {}", name.replace('_', " "))).collect();
    if all.is_empty() { String::new() } else { format!(" ({})", all.join(", ")) }
}

fn hosts(summary: &NetworkStatistics, text: &mut String) {
    for host in &summary.hosts {
        let name = &host.host;
        let _ = match &host.clock {
            None => writeln!(text, "host {name}: launched the run; its clock is the run's"),
            Some(clock) => writeln!(
                text,
                "host {name}: clock {} to {:.1} us (at most {:.1} us), drift {:.2} ppm, there and back in {:.0} us, {} corrections of {:.1} us \
                 at most",
                clock.source,
                clock.error_us,
                clock.error_max_us,
                clock.drift_ppm,
                clock.round_trip_us,
                clock.corrections,
                clock.largest_correction_us,
            ),
        };
        for silence in &host.silences {
            let Silence { host: silent, tick, seconds, healed } = silence;
            let end = if *healed { "; then its messages came again" } else { "" };
            let _ = writeln!(text, "  from tick {tick} on no message came from {silent} for {seconds:.2} s{end}");
        }
        let ill = [
            (host.repeated_frames, "frames sent again"),
            (host.refused_frames, "frames without room"),
            (host.malformed, "malformed messages"),
        ];
        let ill: Vec<String> =
            ill.iter().filter(|(count, _)| *count > 0).map(|(n, what)| format!("{n} {what}")).collect();
        if !ill.is_empty() {
            let _ = writeln!(text, "  {}", ill.join(", "));
        }
    }
    let mut rows = plain(&["between hosts", "way", "sent", "received", "lost", "stale", "p50 us", "p99 us", "max us"]);
    let count = |count: Option<u64>| count.map_or("-".to_owned(), |count| count.to_string());
    for link in &summary.links {
        let short = link.service.splitn(3, '/').nth(2).unwrap_or(&link.service).to_owned();
        let mut row = vec![short, format!("{} to {}", link.from, link.to), count(link.sent), count(link.received)];
        row.extend([link.lost.to_string(), link.stale.to_string()]);
        let shown = link.one_way.filter(Percentiles::are_shown);
        let us = shown.map(|way| [way.p50_us, way.p99_us, way.max_us].map(|us| format!("{us:.0}")));
        row.extend(us.unwrap_or_else(|| ["-".to_owned(), "-".to_owned(), "-".to_owned()]));
        rows.add_row(row);
    }
    let _ = writeln!(text, "\n{rows}");
    for (link, way) in
        summary.links.iter().filter_map(|link| Some((link, link.one_way.filter(|way| !way.are_shown())?)))
    {
        let Percentiles { ahead, ahead_max_us, .. } = way;
        let _ = writeln!(
            text,
            "{}: sent stamps lie up to {ahead_max_us:.1} us ahead of the clock of {} ({ahead} samples): times not shown",
            link.service, link.to
        );
    }
    let error_us = summary.clock_error_us();
    let _ = writeln!(text, "times between hosts are known to {error_us:.1} us\n");
}

fn privileges(summary: &Summary, all: bool, text: &mut String) {
    let granted = summary.privileges.iter().filter(|entry| entry.grant.granted).count();
    let everything = granted == summary.privileges.len() && summary.privileges_unknown.is_empty();
    if summary.privileges.is_empty() || everything && !all {
        return;
    }
    let unknown = match summary.privileges_unknown.join(", ") {
        names if names.is_empty() => names,
        names => format!("; unknown for {names}: no report"),
    };
    let _ = writeln!(text, "privileges: {granted} of {} granted{unknown}", summary.privileges.len());
    // One line per reason, not per role.
    let mut denied: BTreeMap<(&str, &str), Vec<&str>> = BTreeMap::new();
    for entry in summary.privileges.iter().filter(|entry| !entry.grant.granted) {
        denied.entry((&entry.grant.privilege, &entry.grant.reason)).or_default().push(&entry.role);
    }
    for ((privilege, reason), roles) in denied {
        let _ = writeln!(text, "  no {privilege} for {}: {reason}", roles.join(", "));
    }
}

pub(crate) fn plain(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(NOTHING).set_header(header);
    if let Some(first) = table.column_mut(0) {
        first.set_padding((0, 1));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
