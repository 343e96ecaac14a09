//! The tables of a report, from the summary of a run or the end of a recording.

use super::model::{Block, Section};
use super::source::Source;
use super::traces::Traces;
use crate::analysis::{Claim, Reach, apart, digits};
use crate::hosts::{HostStatistics, LinkStatistics, Silence};
use crate::launch::{Criterion, Incident, LinkCounters, StageFigures, State, exact, reasons, short};
use crate::rig::{ConditionReport, Figure};
use crate::telemetry::{MachineInfo, PaceReport, Percentiles, Ticks};

/// An injected fault of the scenario.
#[derive(Debug)]
pub struct FaultRow {
    /// The number on the time axes.
    pub number: usize,
    pub kind: String,
    pub role: String,
    pub from_tick: u64,
    pub ticks: u64,
}

/// Returns the injected faults in the order of time.
pub fn faults(source: &Source) -> Vec<FaultRow> {
    let table = source.scenario.as_ref().and_then(|scenario| scenario.resolved.get("fault"));
    let tables = table.and_then(toml::Value::as_array).into_iter().flatten();
    let row = |fault: &toml::Value| {
        let text = |key: &str| fault.get(key).and_then(toml::Value::as_str).unwrap_or_default().to_owned();
        let ticks = |key: &str| fault.get(key).and_then(toml::Value::as_integer).map_or(0, |n| n.max(0) as u64);
        FaultRow {
            number: 0,
            kind: text("kind"),
            role: text("role"),
            from_tick: ticks("from_tick"),
            ticks: ticks("ticks"),
        }
    };
    let mut rows: Vec<FaultRow> = tables.map(row).collect();
    rows.sort_by_key(|row| row.from_tick);
    rows.iter_mut().enumerate().for_each(|(index, row)| row.number = index + 1);
    rows
}

/// Formats a number in at most eight characters or with five digits.
fn number(value: Option<f64>) -> String {
    let short = |value: f64| Some(format!("{value}")).filter(|text| text.len() <= 8);
    let finite = value.filter(|value| value.is_finite());
    finite.map_or("–".to_owned(), |value| short(value).unwrap_or_else(|| format!("{value:.4e}")))
}

/// Formats a count; a dash if it is unknown.
fn count(count: Option<u64>) -> String {
    count.map_or("–".to_owned(), |count| count.to_string())
}

fn strings(cells: &[&dyn ToString]) -> Vec<String> {
    cells.iter().map(|cell| cell.to_string()).collect()
}

fn held(holds: Option<bool>) -> &'static str {
    match holds {
        Some(true) => "✓ holds",
        Some(false) => "✗ FAILS",
        None => "not judged",
    }
}

/// Builds the section with the criteria and the notes of the scenario.
pub fn verdict(source: &Source, traces: Option<&Traces>) -> Section {
    let mut blocks = Vec::new();
    if let Some(summary) = &source.summary {
        let row = |criterion: &Criterion| {
            let value = criterion.value.map_or("infinite or not measured".to_owned(), short);
            let default = criterion.default.then(|| "default".to_owned());
            let about: Vec<String> =
                [default, criterion.role.clone(), criterion.reason.as_ref().map(ToString::to_string)]
                    .into_iter()
                    .flatten()
                    .collect();
            let about = if about.is_empty() { String::new() } else { format!(" ({})", about.join(", ")) };
            let verdict = format!("{}{about}", held(criterion.holds));
            vec![criterion.name.clone(), value, exact(criterion.limit), verdict]
        };
        let rows: Vec<_> = summary.criteria.iter().map(row).collect();
        if rows.is_empty() {
            blocks.push(Block::Text("The run is not judged: the scenario has no criteria.".to_owned()));
        } else {
            let head = vec!["criterion of [accept]", "value", "limit", "verdict"];
            blocks.push(Block::table("", head, rows));
        }
        blocks.extend(summary.notes.iter().map(|note| Block::Text(format!("Note: {note}."))));
        if summary.signal != 0 {
            blocks.push(Block::Text(format!("Signal {} ended the run before its last tick.", summary.signal)));
        }
        if summary.score.faulted_ticks > 0 {
            let text = format!("A body left the range of its model: {} ticks are lost.", summary.score.faulted_ticks);
            blocks.push(Block::Text(text));
        }
        let (scored, unscored) = (summary.score.scored_ticks, summary.score.unscored_ticks);
        blocks.push(Block::Text(format!("{scored} of {} ticks scored.", scored + unscored)));
    } else {
        blocks.push(Block::Text("The run is not judged: there is no summary.".to_owned()));
    }
    if let Some(traces) = traces.filter(|traces| traces.ticks.is_none()) {
        blocks.push(Block::Text(format!("The recording has no samples of the {} bodies.", traces.bodies.len())));
    }
    Section { id: "verdict", title: "Verdict", blocks }
}

/// Returns the table of degraded statuses that the estimate reported, with their times.
fn unseen(traces: &Traces, tick_s: f64) -> Block {
    let row = |name: &&'static str| {
        let (spans, ticks) = traces.unseen_spans(name);
        let (from, to) = (spans.first().map_or(0, |span| span.0), spans.last().map_or(0, |span| span.1));
        let seconds = |tick: u64| digits(tick as f64 * tick_s);
        strings(&[name, &ticks, &spans.len(), &seconds(from), &seconds(to)])
    };
    let head = vec!["status", "ticks", "intervals", "first from, s", "last until, s"];
    Block::table("Degraded estimate", head, traces.unseen.keys().map(row).collect())
}

/// Builds the section with injected faults, incidents, missing samples and the watchdog.
pub fn events(source: &Source, traces: Option<&Traces>) -> Section {
    let mut blocks = Vec::new();
    let tick_s = source.scenario.as_ref().map_or(0.0, |scenario| scenario.tick_s());
    let seconds = |tick: u64| digits(tick as f64 * tick_s);
    let row =
        |fault: &FaultRow| strings(&[&fault.number, &seconds(fault.from_tick), &fault.ticks, &fault.kind, &fault.role]);
    let rows: Vec<_> = faults(source).iter().map(row).collect();
    let fault = if rows.is_empty() { "" } else { "numbered band: injected fault; " };
    let degraded =
        if traces.is_some_and(|traces| !traces.unseen.is_empty()) { "grey band: degraded estimate; " } else { "" };
    blocks.push(Block::Text(format!(
        "Marks in charts over time: {fault}{degraded}dashed line with a flag: incident; bar at the bottom: a role sent no \
         sample."
    )));
    let head = vec!["number", "from, s", "ticks", "fault", "role"];
    blocks.extend((!rows.is_empty()).then(|| Block::table("Injected faults", head, rows)));
    blocks.extend(traces.map(|traces| unseen(traces, tick_s)));
    let incidents = source.summary.as_ref().map_or(&[][..], |summary| &summary.incidents);
    let time = |seconds: Option<f64>| seconds.map_or("–".to_owned(), digits);
    let row = |incident: &Incident| {
        let cause = match incident.last_words.as_str() {
            "" => incident.cause.clone(),
            words => format!("{}; last output: {words}", incident.cause),
        };
        let (outage, recovery) = (time(incident.outage_s), time(incident.recovery_s));
        strings(&[&seconds(incident.tick), &incident.role, &cause, &incident.action.name(), &outage, &recovery])
    };
    let rows: Vec<_> = incidents.iter().map(row).collect();
    let head = vec!["at, s", "role", "cause", "action", "outage, s", "recovery, s"];
    blocks.extend((!rows.is_empty()).then(|| Block::table("Incidents", head, rows)));
    if let Some(traces) = traces {
        let (_, ticks) = traces.missing();
        blocks.push(Block::Text(format!("Missing samples, all roles: {ticks}.")));
    }
    if let Some(watchdog) = source.summary.as_ref().and_then(|summary| summary.watchdog.as_ref()) {
        let row = |watched: &crate::telemetry::WatchedReport| {
            let first = watched.first_tick.map_or("–".to_owned(), seconds);
            let [bound, largest] = [Some(watched.max), watched.largest].map(number);
            strings(&[&watched.quantity, &bound, &largest, &watched.judged, &watched.breaches, &first])
        };
        let rows = watchdog.watched.iter().map(row).collect();
        let head = vec!["quantity", "bound", "largest", "ticks checked", "ticks beyond", "first at, s"];
        blocks.push(Block::table("Watchdog", head, rows));
        if let Some(tick) = watchdog.latched_at_tick {
            blocks.push(Block::Text(format!("The safe command was latched at {} s.", seconds(tick))));
        }
    }
    Section { id: "events", title: "Events", blocks }
}

/// Returns the table of latency percentiles of every stage.
pub fn latencies(source: &Source) -> Block {
    let row = |stage: &StageFigures| {
        let mut row = strings(&[&stage.role, &stage.stage]);
        row.extend(figures_cells(&stage.figures));
        row
    };
    let rows = source.summary.iter().flat_map(|summary| &summary.latencies).map(row).collect();
    let head = vec!["role", "stage", "count", "missed", "50 %, µs", "99 %, µs", "99.9 %, µs", "max, µs"];
    Block::table("", head, rows)
}

/// Formats count, missed, 50 %, 99 %, 99.9 % and maximum of a stage; dashes if its stamps have different clocks.
pub fn figures_cells(figures: &Percentiles) -> [String; 6] {
    let us = |value: f64| if value.is_nan() { "–".to_owned() } else { format!("{value:.2}") };
    let Percentiles { count, missed, p50_us, p99_us, p999_us, max_us, .. } = *figures;
    [count.to_string(), missed.to_string(), us(p50_us), us(p99_us), us(p999_us), us(max_us)]
}

fn ticks_row((role, ticks): (&String, &Ticks)) -> Vec<String> {
    let Ticks { elapsed, executed, missed, starved, late, safe, stalled, .. } = ticks;
    let late = late.map_or_else(|| "–".to_owned(), |late| late.to_string());
    strings(&[role, elapsed, executed, missed, starved, &late, safe, stalled])
}

/// Builds the table of the device that sets the pace, if one does.
fn paces(source: &Source) -> Option<Block> {
    let paces = source.summary.as_ref().map(|summary| &summary.pace).filter(|paces| !paces.is_empty())?;
    let row = |(role, pace): (&String, &PaceReport)| {
        strings(&[
            role,
            &pace.state,
            &number(pace.locked_after_s),
            &number(pace.phase_error_p50_us),
            &number(pace.phase_error_p99_us),
            &number(pace.phase_error_max_us),
            &number(Some(pace.drift_ppm)),
            &pace.slips,
            &number(Some(pace.holdover_s)),
            &number(pace.relocked_after_s_max),
        ])
    };
    let head = vec![
        "device",
        "state",
        "locked after, s",
        "phase error p50, µs",
        "p99, µs",
        "max, µs",
        "drift, ppm",
        "slips",
        "holdover, s",
        "locked again after, s",
    ];
    Some(Block::table("Pace", head, paces.iter().map(row).collect()))
}

/// Builds the section with the counters of roles, links, hosts and the recording.
pub fn books(source: &Source) -> Section {
    let mut blocks = Vec::new();
    let roles = ["role", "elapsed", "executed", "missed", "starved", "late", "safe", "stalled"];
    if let Some(books) = source.summary.as_ref().map(|summary| &summary.books) {
        let balance = if books.balanced { "The counters balance." } else { "THE COUNTERS DO NOT BALANCE." };
        let scripted = !faults(source).is_empty() || books.injected_faults > 0;
        let acted = format!("; injected faults acted {} times", books.injected_faults);
        blocks.push(Block::Text(format!(
            "{balance} Missed or starved: {} ticks; rejected: {} samples{}{}.",
            books.missed_ticks,
            books.rejected_samples,
            reasons(&books.rejected_by),
            if scripted { &acted } else { "" }
        )));
        blocks.extend(books.problems.iter().map(|problem| Block::Text(problem.clone())));
        if !books.unbooked.is_empty() {
            let unbooked = books.unbooked.join(", ");
            blocks.push(Block::Text(format!("No counters from {unbooked}: readers count the samples.")));
        }
        let rows = books.roles.iter().map(ticks_row).collect();
        blocks.push(Block::table("Ticks", roles.to_vec(), rows));
        let row = |link: &LinkCounters| {
            let void = format!("{}, {}", count(link.void.0), link.void.1);
            strings(&[
                &link.service,
                &link.reader,
                &count(link.published),
                &link.received,
                &link.gaps,
                &void,
                &count(link.unread),
                &link.stale,
                &format!("{}{}", link.rejected, reasons(&link.rejected_by)),
            ])
        };
        let rows = books.links.iter().map(row).collect();
        let head = vec![
            "signal",
            "reader",
            "published",
            "received",
            "gaps",
            "no-sample markers sent, received",
            "unread",
            "stale",
            "rejected",
        ];
        blocks.push(Block::table("Samples", head, rows));
    } else if let Some(end) = source.recording.as_ref().and_then(|recording| recording.info().end.as_ref()) {
        let rows = end.ticks.iter().map(ticks_row).collect();
        blocks.push(Block::table("Ticks", roles.to_vec(), rows));
    }
    blocks.extend(paces(source));
    blocks.extend(hosts(source));
    blocks.extend(recorded(source));
    if let Some((summary, state)) = source.summary.as_ref().map(|summary| (summary, &summary.state)) {
        let undisturbed = || {
            let unbooked = !summary.books.unbooked.is_empty();
            State::undisturbed_words(state.elapsed_ticks, summary.last_tick + 1, unbooked)
        };
        let disturbed =
            state.first_disturbed_tick.map_or_else(undisturbed, |tick| format!("first disturbed tick {tick}"));
        blocks.push(Block::Text(format!("State hash {}; {disturbed}.", state.hash)));
    }
    Section { id: "books", title: "Accounting", blocks }
}

/// Returns the tables of hosts and of the links between them, if the run had several hosts.
fn hosts(source: &Source) -> Vec<Block> {
    let Some(hosts) = source.summary.as_ref().and_then(|summary| summary.hosts.as_ref()) else { return Vec::new() };
    let clock = |host: &HostStatistics| {
        let Some(clock) = &host.clock else {
            return strings(&[&host.host, &"reference", &"–", &"–", &"–", &"–"]);
        };
        let short = |value: f64| format!("{value:.1}");
        let [error, largest] = [clock.error_max_us, clock.largest_correction_us].map(short);
        strings(&[&host.host, &clock.source, &error, &short(clock.drift_ppm), &short(clock.round_trip_us), &largest])
    };
    let head = vec!["host", "clock", "error bound, µs", "drift, ppm", "round trip, µs", "largest correction, µs"];
    let mut blocks = vec![Block::table("Hosts", head, hosts.hosts.iter().map(clock).collect())];
    let silences = hosts.hosts.iter().flat_map(|host| host.silences.iter().map(move |silence| (host, silence)));
    blocks.extend(silences.map(|(host, silence)| {
        let Silence { host: sender, tick, seconds, healed } = silence;
        let end = if *healed { "; then the link recovered" } else { "" };
        Block::Text(format!(
            "From tick {tick} on, {} received nothing from {sender} for {seconds:.2} s{end}.",
            host.host
        ))
    }));
    let row = |link: &LinkStatistics| {
        let us = |percentile: fn(&Percentiles) -> f64| {
            link.one_way
                .filter(Percentiles::are_shown)
                .map_or("–".to_owned(), |way| format!("{:.0}", percentile(&way)))
        };
        let way = format!("{} to {}", link.from, link.to);
        let [p50, p99] = [us(|way| way.p50_us), us(|way| way.p99_us)];
        strings(&[&link.service, &way, &count(link.sent), &count(link.received), &link.lost, &link.stale, &p50, &p99])
    };
    let head = vec!["signal", "between hosts", "sent", "received", "lost", "stale", "one way 50 %, µs", "99 %, µs"];
    blocks.push(Block::table("Links between hosts", head, hosts.links.iter().map(row).collect()));
    blocks
}

fn recorded(source: &Source) -> Vec<Block> {
    let mut blocks = Vec::new();
    if let Some(recorded) = source.summary.as_ref().and_then(|summary| summary.recording.as_ref()) {
        let whole = if recorded.complete { "complete" } else { "not complete" };
        let problem = recorded.problem.as_deref().map_or(String::new(), |problem| format!(": {problem}"));
        blocks.push(Block::Text(format!(
            "The recording is {whole}{problem}; {} samples in {} bytes.",
            recorded.messages, recorded.bytes
        )));
    }
    if let Some(end) = source.recording.as_ref().and_then(|recording| recording.info().end.as_ref()) {
        let row = |signal: &crate::record::SignalReport| {
            let (published, lost) = (count(signal.published), count(signal.lost));
            strings(&[&signal.service, &signal.recorded, &signal.void, &signal.extra, &published, &lost])
        };
        let rows = end.signals.iter().map(row).collect();
        let head = vec!["signal", "recorded", "no-sample markers", "extra", "published", "lost"];
        blocks.push(Block::table("Recording", head, rows));
    }
    blocks
}

/// Builds the section with the certificates and the limits of the guards.
pub fn certificate(source: &Source) -> Section {
    let mut blocks = Vec::new();
    let Some(summary) = &source.summary else {
        return Section { id: "certificate", title: "Certificate", blocks };
    };
    for certificate in &summary.certificates {
        let row = |condition: &ConditionReport| {
            let [value, required] = apart(condition.value, condition.required);
            let verdict = if condition.holds { "✓ holds" } else { "✗ does not hold" };
            strings(&[&condition.name, &value, &required, &verdict])
        };
        let continuous = certificate.continuous_rate_per_s.map_or(String::new(), |rate| {
            format!("; with the continuous law the error decays at least as fast as exp(−{} t)", digits(rate))
        });
        let caption = format!("{}{continuous}", certificate.body);
        let rows: Vec<_> = certificate.conditions.iter().map(row).collect();
        blocks.push(match rows.is_empty() {
            true => Block::Text(format!("{caption}: the rig has no proof for the continuous law.")),
            false => Block::table(&caption, vec!["condition", "value", "required", ""], rows),
        });
        blocks.push(Block::Text(loop_claim(certificate)));
        // The text above contains the reason that no rate is claimed.
        let warnings = certificate.warnings.iter().filter(|warning| certificate.reason.as_ref() != Some(*warning));
        blocks.extend(warnings.map(|warning| Block::Text(format!("Warning: {warning}."))));
    }
    if let Some(score) = &summary.score.certificate {
        let (held, broken, judged) = (score.held, score.broken, score.held + score.broken);
        let result = match broken {
            0 => format!("holds at all {judged} checked steps"),
            _ => format!("fails at {broken} of {judged} checked steps and holds at {held}"),
        };
        blocks.push(Block::Text(format!("The bound on dV/dt {result}; {} steps were not checked.", score.unjudged)));
    }
    let rows: Vec<_> = summary.limits.iter().map(|limit| vec![limit.name.clone(), number(Some(limit.value))]).collect();
    blocks.extend((!rows.is_empty()).then(|| Block::table("Limits of the guards", vec!["limit", "value"], rows)));
    Section { id: "certificate", title: "Certificate", blocks }
}

/// Describes the claims about the sampled loop.
fn loop_claim(certificate: &Claim) -> String {
    let rate = match (certificate.loop_rate_text(), &certificate.reason) {
        (Some(rate), _) => format!("a small error decays as exp(−{rate} t)"),
        (None, reason) => format!("no rate is claimed: {}", reason.as_deref().unwrap_or("none was computed")),
    };
    let floor = |floor: &Figure| format!("{} {}", floor.name, number(Some(floor.value)));
    let floors: Vec<String> = certificate.floors.iter().map(floor).collect();
    let floors = if floors.is_empty() { String::new() } else { format!(" Expected floors: {}.", floors.join(", ")) };
    let over =
        certificate.over_s.map_or(String::new(), |over_s| format!(", computed over the first {} s", digits(over_s)));
    let reach = |reach: &Reach| match reach.after_s {
        Some(after_s) => format!("{} ≤ {} after {} s at this rate", reach.metric, digits(reach.limit), digits(after_s)),
        None => format!("{} ≤ {} is below the floor", reach.metric, digits(reach.limit)),
    };
    let reaches: String =
        certificate.reaches.iter().map(|limit| format!(" From the initial error: {}.", reach(limit))).collect();
    format!("Sampled loop of {}: {rate}{over}.{floors}{reaches}", certificate.body)
}

/// Builds the section with the machine, the privileges and the scenario.
pub fn machine(source: &Source) -> Section {
    let mut blocks = Vec::new();
    let info = source.recording.as_ref().map(|recording| recording.info());
    let recorded = info.and_then(|info| serde_json::from_str::<MachineInfo>(&info.host).ok());
    if let Some(host) = source.summary.as_ref().map(|summary| &summary.host).or(recorded.as_ref()) {
        blocks.push(Block::Text(format!("{}: {}, {} cores, {}.", host.name, host.cpu, host.cores, host.kernel)));
    }
    let of_run = source.summary.iter().flat_map(|summary| &summary.privileges).map(|entry| (&entry.role, &entry.grant));
    let of_file = info.and_then(|info| info.end.as_ref()).filter(|_| source.summary.is_none());
    let of_file = of_file.into_iter().flat_map(|end| &end.privileges);
    let of_file = of_file.flat_map(|(role, grants)| grants.iter().map(move |grant| (role, grant)));
    let row = |(role, grant): (&String, &crate::telemetry::Grant)| {
        let granted = if grant.granted { "✓ granted" } else { "✗ not granted" };
        strings(&[role, &grant.privilege, &grant.asked, &granted, &grant.reason])
    };
    let rows: Vec<_> = of_run.chain(of_file).map(row).collect();
    if rows.is_empty() {
        blocks.push(Block::Text("No privileges were requested.".to_owned()));
    } else {
        let head = vec!["role", "privilege", "requested", "result", "reason"];
        blocks.push(Block::table("Privileges", head, rows));
    }
    if let Some(run) = source.run() {
        blocks.push(Block::Text(format!("Run {run}.")));
    }
    if let Some(info) = info {
        let text = format!("Recorded by {}; scenario hash {}, seed {}.", info.version, info.scenario_hash, info.seed);
        blocks.push(Block::Text(text));
    }
    if let Some(scenario) = &source.scenario {
        blocks.push(Block::Details("Resolved scenario".to_owned(), scenario.to_toml()));
    }
    Section { id: "machine", title: "Machine and privileges", blocks }
}
