//! The criteria of a run: each value beside its limit, and the verdict on the whole run.
//!
//! Must not pass what was not measured: a criterion without all its data is not judged, and neither is the run.

use super::incident::Action;
use super::outcome::Outcome;
use super::outcome::{Accounting, StageFigures, links_of};
use crate::config::{ClockKind, TickAmount, TickLimit};
use crate::fault::{Action as FaultAction, Interruption};
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use crate::score::StepResponse;
use crate::telemetry::{PaceReport, Percentiles, Ticks};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// The part of a role's ticks that may be missed, and starved, where a scenario states no limit.
const DEFAULT_SHARE: TickAmount = TickAmount::Share(0.01);
/// The time limit for noticing the death of a role, s.
const NOTICED_S: f64 = 0.1;

/// A criterion on a latency: key, stage and figure.
type LatencyCriterion = (&'static str, &'static str, fn(&Percentiles) -> f64);

/// A criterion on a response to a step: key, figure, and true if it applies to set points only.
type ResponseCriterion = (&'static str, fn(&StepResponse) -> Option<f64>, bool);

/// The criteria on responses.
const RESPONSES: [ResponseCriterion; 5] = [
    ("rise_time_s_max", |response| response.rise_time_s, true),
    ("overshoot_max", |response| response.overshoot, true),
    ("settling_time_s_max", |response| response.settling_time_s, false),
    ("steady_state_error_max", |response| Some(response.steady_state_error), false),
    ("command_peak_max", |response| response.command_max, false),
];

/// The criteria on latencies. Step and age are those of observer and controller: a body's age includes the time until its command
/// is due.
const LATENCIES: [LatencyCriterion; 6] = [
    ("step_latency_p99_us_max", "step", |figures| figures.p99_us),
    ("age_p99_us_max", "age", |figures| figures.p99_us),
    ("age_p999_us_max", "age", |figures| figures.p999_us),
    ("age_max_us", "age", |figures| figures.max_us),
    ("lateness_p99_us_max", "lateness", |figures| figures.p99_us),
    ("lateness_max_us", "lateness", |figures| figures.max_us),
];

/// A criterion on the pace of a device: key, and figure if it was measured.
type PaceCriterion = (&'static str, fn(&PaceReport) -> Option<f64>);

/// The criteria on the pace of a device.
const PACES: [PaceCriterion; 2] =
    [("phase_error_p99_us_max", |pace| pace.phase_error_p99_us), ("slips_max", |pace| Some(pace.slips as f64))];

/// A criterion and its verdict.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Criterion {
    /// The key in `[accept]`.
    pub name: String,
    /// The limit.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub limit: f64,
    /// The value; none if it was not measured.
    pub value: Option<f64>,
    /// True if it holds, false if not; none if it cannot be judged.
    pub holds: Option<bool>,
    /// The role with the largest value, where each has its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub role: Option<String>,
    /// The reason for which it is not judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Unjudged>,
    /// True if the scenario states no such limit, and the default holds.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub default: bool,
}

/// Returns a count as a whole number, and any other value in scientific notation with all its digits.
pub fn exact(value: f64) -> String {
    if is_count(value) { format!("{value}") } else { format!("{value:e}") }
}

/// Returns a count as a whole number, and any other value in scientific notation with three digits.
pub fn short(value: f64) -> String {
    if is_count(value) { format!("{value}") } else { format!("{value:.2e}") }
}

fn is_count(value: f64) -> bool {
    value.fract() == 0.0 && value.abs() < 1e9
}

/// The reason for which a criterion is not judged.
#[derive(Debug, Clone, PartialEq)]
pub enum Unjudged {
    /// The clock does not measure it.
    Clock,
    /// The run was stopped before it applies.
    Stopped,
    /// The scenario ends before it applies: the key of the instant, and the instant, s.
    Early(&'static str, f64),
    /// Ticks have no score: their number, the number of all ticks from an instant on, and that instant, s.
    Unscored(u64, u64, f64),
    /// The role keeps no counters.
    Unbooked,
    /// No input made such a step.
    NoStep,
    /// No device set the pace.
    NoPace,
    /// A reason read back from a summary.
    Recorded(String),
}

impl fmt::Display for Unjudged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Clock => f.write_str("this clock does not measure it"),
            Self::Stopped => f.write_str("the run was stopped before it applies"),
            Self::Early(key, instant_s) => write!(f, "ends before {key} ({instant_s} s)"),
            Self::Unscored(unscored, ticks, from_s) => {
                write!(f, "{unscored} of {ticks} ticks from {from_s} s on were not scored")
            }
            Self::Unbooked => f.write_str("the role keeps no counters"),
            Self::NoStep => f.write_str("no input made such a step"),
            Self::NoPace => f.write_str("no device set the pace"),
            Self::Recorded(reason) => f.write_str(reason),
        }
    }
}

impl Serialize for Unjudged {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Unjudged {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer).map(Self::Recorded)
    }
}

impl Criterion {
    fn new(name: impl Into<String>, limit: f64, value: Option<f64>) -> Self {
        let holds = Some(value.is_some_and(|value| value <= limit));
        Self { name: name.into(), limit, value, holds, role: None, reason: None, default: false }
    }

    /// Returns the name, with the role, and a mark if the limit is the default.
    pub(super) fn label(&self) -> String {
        let role = self.role.as_ref().map_or(String::new(), |role| format!(", {role}"));
        format!("{}{}{role}", self.name, if self.default { " (default)" } else { "" })
    }

    /// Returns the criterion as not judged for a reason. A limit that is exceeded stays exceeded.
    fn unless(mut self, reason: Option<Unjudged>) -> Self {
        let exceeded = self.value.is_some_and(|value| value > self.limit);
        if reason.is_some() && !exceeded {
            (self.holds, self.reason) = (None, reason);
        }
        self
    }
}

/// The ticks of one role.
struct Counted<'a> {
    role: &'a str,
    elapsed: u64,
    missed: Option<u64>,
    starved: Option<u64>,
    safe: Option<u64>,
    late: Option<u64>,
}

/// The judge of one run.
pub(super) struct Judge<'a> {
    pub scenario: &'a Scenario,
    pub outcome: &'a Outcome,
    pub books: &'a Accounting,
    pub latencies: &'a [StageFigures],
    pub interrupted: bool,
}

impl Judge<'_> {
    /// Judges the results by the criteria.
    pub fn criteria(&self) -> Vec<Criterion> {
        let accept = &self.scenario.accept;
        let mut criteria = self.metrics();
        let score = &self.outcome.score;
        // Not optional: a run that lost a body is not accepted.
        if score.faulted_ticks > 0 {
            criteria.push(Criterion::new("faulted_ticks_max", 0.0, Some(score.faulted_ticks as f64)));
        }
        if !accept.is_empty() {
            criteria.extend(self.ticks());
        }
        if let Some(amount) = accept.unscored_ticks_max {
            let unscored = self.unscored(0, score.unscored_ticks);
            let limit = amount.count(self.ticks_from(0)) as f64;
            criteria.push(Criterion::new("unscored_ticks_max", limit, Some(unscored as f64)));
        }
        criteria.extend(accept.latency_max_us.iter().map(|(key, limit)| self.latency(key, *limit)));
        criteria.extend(accept.pace_max.iter().map(|(key, limit)| self.pace(key, *limit)));
        criteria.extend(accept.response_max.iter().map(|(key, limit)| self.response(key, *limit)));
        criteria
    }

    /// Judges the role with the largest latency.
    fn latency(&self, key: &str, limit: f64) -> Criterion {
        let (_, stage, figure) = LATENCIES[LATENCIES.iter().position(|(name, ..)| *name == key).unwrap_or(0)];
        let acts = |role: &str| {
            let plant = matches!(RoleId::named(self.scenario, role), Some(RoleId::Plant(_)));
            stage == "lateness" || !plant
        };
        let judged = self.latencies.iter().filter(|row| row.stage == stage && acts(&row.role));
        let figures = judged.map(|row| (&row.role, figure(&row.figures)));
        // NaN is above every number: a stage without a figure was not measured, and then the largest is not known.
        let worst = figures.max_by(|(_, a), (_, b)| a.total_cmp(b)).filter(|(_, us)| !us.is_nan());
        // Without a clock there is no latency to judge; in real time a missing one is a failure.
        let reason = (self.scenario.clock != ClockKind::Realtime).then_some(Unjudged::Clock);
        let criterion = Criterion::new(key, limit, worst.map(|(_, us)| us)).unless(reason);
        Criterion { role: worst.map(|(role, _)| role.clone()), ..criterion }
    }

    /// Judges the device that sets the pace.
    fn pace(&self, key: &str, limit: f64) -> Criterion {
        let (_, figure) = PACES[PACES.iter().position(|(name, _)| *name == key).unwrap_or(0)];
        let paced = self.outcome.reports.iter().find_map(|report| Some((&report.role, report.pace.as_ref()?)));
        let reason = match self.scenario.clock {
            ClockKind::Realtime => paced.is_none().then_some(Unjudged::NoPace),
            _ => Some(Unjudged::Clock),
        };
        let criterion = Criterion::new(key, limit, paced.and_then(|(_, pace)| figure(pace))).unless(reason);
        Criterion { role: paced.map(|(role, _)| role.clone()), ..criterion }
    }

    /// Judges the response with the largest figure. One without the figure, such as one that does not settle, does not hold.
    fn response(&self, key: &str, limit: f64) -> Criterion {
        let (_, figure, set_points) = RESPONSES[RESPONSES.iter().position(|(name, ..)| *name == key).unwrap_or(0)];
        let responses = self.outcome.score.responses.iter();
        let judged = responses.filter(|response| !set_points || response.overshoot.is_some());
        let figures: Vec<Option<f64>> = judged.map(figure).collect();
        let all: Option<Vec<f64>> = figures.iter().copied().collect();
        let worst = all.and_then(|all| all.into_iter().max_by(f64::total_cmp));
        Criterion::new(key, limit, worst).unless(figures.is_empty().then_some(Unjudged::NoStep))
    }

    fn metrics(&self) -> Vec<Criterion> {
        let (accept, score) = (&self.scenario.accept, &self.outcome.score);
        let find = |metric: &String| score.metrics.iter().find(|score| score.name == *metric);
        let settled = accept.metric_max.iter().map(|(metric, limit)| {
            let score = find(metric);
            let (value, blank) =
                (score.and_then(|score| score.settled_max), score.map_or(0, |score| score.settled_blank));
            let criterion = Criterion::new(format!("{metric}_max"), *limit, value);
            criterion.unless(self.unseen("settled_by_s", accept.settled_by_s, value, blank))
        });
        let peaks = accept.metric_peak.iter().map(|(metric, limit)| {
            let score = find(metric);
            let (value, blank) = (score.and_then(|score| score.peak), score.map_or(0, |score| score.peak_blank));
            let criterion = Criterion::new(format!("{metric}_peak"), *limit, value);
            criterion.unless(self.unseen("peak_from_s", accept.peak_from_s, value, blank))
        });
        settled.chain(peaks).collect()
    }

    /// Returns the reason for which a metric cannot be judged from an instant on, if there is one; `blank` ticks have no value.
    fn unseen(&self, key: &'static str, from_s: f64, value: Option<f64>, blank: u64) -> Option<Unjudged> {
        let last_tick = self.scenario.last_tick;
        if self.scenario.time_s(last_tick) < from_s {
            return Some(Unjudged::Early(key, from_s));
        }
        let from_tick = ((from_s / self.scenario.tick_s()).ceil() as u64).min(last_tick);
        if self.interrupted {
            return value.is_none().then_some(Unjudged::Stopped);
        }
        // A metric that was never measured does not hold.
        value?;
        let ticks = self.ticks_from(from_tick);
        let blank = self.unscored(from_tick, blank);
        let allowed = match self.scenario.accept.unscored_ticks_max {
            Some(amount) => amount.count(ticks),
            // A tick that a role missed has no sample, and counts as missed. A sample that was sent but not scored may have been the
            // worst.
            None if self.lost_samples() == Some(0) => DEFAULT_SHARE.count(ticks),
            None => 0,
        };
        (blank > allowed).then_some(Unjudged::Unscored(blank, ticks, from_s))
    }

    /// Returns the number of ticks from `from_tick` on.
    fn ticks_from(&self, from_tick: u64) -> u64 {
        self.scenario.last_tick + 1 - from_tick
    }

    /// Returns the number of ticks from `from_tick` on without a score: those that the scorer passed over, and those after its end.
    fn unscored(&self, from_tick: u64, passed_over: u64) -> u64 {
        let score = &self.outcome.score;
        let end = score.scored_ticks + score.unscored_ticks;
        let rest = if self.interrupted { 0 } else { (self.scenario.last_tick + 1).saturating_sub(end.max(from_tick)) };
        passed_over + rest
    }

    /// Returns the number of samples that were sent to the scorer and did not reach it; none if no writer keeps counters.
    fn lost_samples(&self) -> Option<u64> {
        let written = || self.outcome.reports.iter().flat_map(|report| &report.written);
        let received = self.outcome.score.received.iter();
        let lost = received.filter_map(|(service, received)| {
            let writer = written().find(|link| link.service == *service)?;
            Some(writer.published.saturating_sub(*received))
        });
        lost.reduce(|sum, count| sum + count)
    }

    /// Returns the criteria on missed, starved and safe ticks, stated or by default.
    fn ticks(&self) -> Vec<Criterion> {
        let accept = &self.scenario.accept;
        let roles = self.roles();
        let scripted = self.scripted_ticks();
        // A count limits all ticks; a share does not include the ticks that the scenario's own faults take.
        let granted = |amount: TickAmount, ticks: u64| match amount {
            TickAmount::Count(count) => count,
            TickAmount::Share(_) => amount.count(ticks) + scripted,
        };
        let mut criteria = Vec::new();
        for (name, limit, count, default) in [
            (
                "missed_ticks_max",
                &accept.missed_ticks_max,
                (|role| role.missed) as fn(&Counted<'_>) -> Option<u64>,
                Some(DEFAULT_SHARE),
            ),
            ("starved_ticks_max", &accept.starved_ticks_max, |role| role.starved, Some(DEFAULT_SHARE)),
            ("safe_ticks_max", &accept.safe_ticks_max, |role| role.safe, Some(TickAmount::Share(0.0))),
            ("late_ticks_max", &accept.late_ticks_max, |role| role.late, None),
        ] {
            // Without real time no tick is late, and an external role may not count late ticks.
            let reason = match name == "late_ticks_max" {
                true if self.scenario.clock != ClockKind::Realtime => Some(Unjudged::Clock),
                true if roles.iter().any(|role| role.late.is_none()) => Some(Unjudged::Unbooked),
                _ => None,
            };
            match limit {
                // As in older scenarios: the sum over all roles.
                Some(TickLimit::All(TickAmount::Count(limit))) if name == "missed_ticks_max" => {
                    let all =
                        roles.iter().map(|role| role.missed.unwrap_or(0) + role.starved.unwrap_or(0)).sum::<u64>();
                    criteria.push(Criterion::new(name, *limit as f64, Some(all as f64)));
                }
                Some(TickLimit::All(amount)) => {
                    let unknown = || reason.is_some().then(|| Criterion::new(name, granted(*amount, 0) as f64, None));
                    let worst = worst(name, &roles, count, |ticks| granted(*amount, ticks)).or_else(unknown);
                    criteria.extend(worst.map(|criterion| criterion.unless(reason)));
                }
                Some(TickLimit::ByRole(by_role)) => criteria.extend(by_role.iter().map(|(role, amount)| {
                    let counted = roles.iter().find(|counted| counted.role == role);
                    let value = counted.and_then(count).map(|ticks| ticks as f64);
                    let limit = granted(*amount, counted.map_or(0, |counted| counted.elapsed)) as f64;
                    let clock = reason.clone().filter(|reason| *reason == Unjudged::Clock);
                    let reason = if value.is_none() { Some(Unjudged::Unbooked) } else { clock };
                    Criterion::new(format!("{name}.{role}"), limit, value).unless(reason)
                })),
                None => {
                    let by_default =
                        default.and_then(|amount| worst(name, &roles, count, |ticks| granted(amount, ticks)));
                    criteria.extend(by_default.map(|criterion| Criterion { default: true, ..criterion }));
                }
            }
        }
        let absent = self.absent_roles();
        if let Some(role) = absent.first() {
            let role = Some((*role).to_owned());
            criteria.push(Criterion { role, ..Criterion::new("absent_roles_max", 0.0, Some(absent.len() as f64)) });
        }
        criteria
    }

    /// Returns the roles' counts. A role without counters missed the ticks that its readers lack.
    fn roles(&self) -> Vec<Counted<'_>> {
        let booked = self.books.roles.iter().map(|(role, ticks)| {
            let Ticks { elapsed, excused, .. } = *ticks;
            let [missed, starved, safe] =
                [(ticks.missed, excused.missed), (ticks.starved, excused.starved), (ticks.safe, excused.safe)]
                    .map(|(all, excused)| all.saturating_sub(excused));
            let late = ticks.late.map(|late| missed + starved + late.saturating_sub(excused.late));
            Counted { role, elapsed, missed: Some(missed), starved: Some(starved), safe: Some(safe), late }
        });
        let elapsed = self.elapsed();
        let unbooked = self.books.absent_ticks.iter();
        let unbooked = unbooked.map(|(role, absent)| Counted {
            role,
            elapsed,
            missed: Some(*absent),
            starved: None,
            safe: None,
            late: None,
        });
        booked.chain(unbooked).collect()
    }

    /// Returns the number of ticks that elapsed.
    fn elapsed(&self) -> u64 {
        let booked = self.books.roles.values().map(|ticks| ticks.elapsed).max();
        booked.unwrap_or(if self.interrupted { 0 } else { self.scenario.last_tick + 1 })
    }

    /// Returns the roles that sent no more samples at the end of the run.
    fn absent_roles(&self) -> Vec<&str> {
        if self.interrupted {
            return Vec::new();
        }
        let elapsed = self.elapsed();
        let late =
            DEFAULT_SHARE.count(elapsed).max(self.scenario.command_timeout_ticks) + self.scenario.actuation_delay_ticks;
        let absent = |role: &&String| {
            let covered = links_of(self.scenario, role, &self.books.links)
                .map(|link| link.received + link.void.1 + link.gaps)
                .max();
            covered.is_some_and(|covered| covered + late < elapsed)
        };
        self.books.unbooked.iter().filter(absent).map(String::as_str).collect()
    }

    /// Returns the largest number of ticks that scripted faults may have cost a role.
    fn scripted_ticks(&self) -> u64 {
        let (scenario, period_ns) = (self.scenario, self.scenario.period_ns);
        let stall_ticks = scenario.faults.iter().map(|fault| match fault.fault.action {
            FaultAction::Role(Interruption::Stall { ns }) => ns.div_ceil(period_ns),
            _ => 0,
        });
        let stalls = self.books.roles.values().map(|ticks| ticks.stalled).sum::<u64>() * stall_ticks.max().unwrap_or(0);
        let killed = |role: &str| {
            let kill = |fault: &&crate::config::ScriptedFault| {
                matches!(fault.fault.action, FaultAction::Role(Interruption::Kill))
            };
            scenario.faults.iter().filter(kill).any(|fault| fault.role == role)
        };
        let outages = self.outcome.incidents.iter().filter(|incident| {
            incident.action == Action::Restarted
                && incident.with.iter().chain([&incident.role]).any(|role| killed(role))
        });
        let seconds =
            outages.filter_map(|incident| incident.outage_s).map(|outage_s| outage_s + NOTICED_S).sum::<f64>();
        self.books.injected_faults + stalls + (seconds / scenario.tick_s()).ceil() as u64
    }
}

/// Returns the criterion of the role that is closest to its limit, or furthest beyond; `None` if no role counts such ticks.
fn worst(
    name: &str,
    roles: &[Counted<'_>],
    count: impl Fn(&Counted<'_>) -> Option<u64>,
    limit: impl Fn(u64) -> u64,
) -> Option<Criterion> {
    let counted = roles.iter().filter_map(|role| Some((role.role, count(role)?, limit(role.elapsed))));
    let (role, ticks, limit) = counted.max_by_key(|(_, ticks, limit)| (*ticks as i128 - *limit as i128, *ticks))?;
    let role = (ticks > 0).then(|| role.to_owned());
    Some(Criterion { role, ..Criterion::new(name, limit as f64, Some(ticks as f64)) })
}

/// Returns true if a run is accepted by its criteria; `None` if nothing was judged, if the run was `interrupted` before
/// anything failed, or if a criterion could not be judged that the run should have measured.
pub(super) fn accepted(criteria: &[Criterion], interrupted: bool) -> Option<bool> {
    if criteria.iter().any(|criterion| criterion.holds == Some(false)) {
        return Some(false);
    }
    // Criteria that hold by default alone do not make a run accepted.
    let judged = criteria.iter().any(|criterion| criterion.holds.is_some() && !criterion.default);
    (judged && !interrupted && first_open(criteria).is_none()).then_some(true)
}

/// Returns the first reason for which a run cannot be accepted.
fn first_open(criteria: &[Criterion]) -> Option<&Unjudged> {
    criteria.iter().filter_map(|criterion| criterion.reason.as_ref()).find(|reason| **reason != Unjudged::Clock)
}

/// Returns the verdict in words.
pub(super) fn verdict(accepted: Option<bool>, criteria: &[Criterion], interrupted: bool) -> String {
    match accepted {
        Some(true) => "accepted".to_owned(),
        Some(false) => "not accepted".to_owned(),
        None if criteria.is_empty() => "not judged: the scenario has no criteria".to_owned(),
        None if interrupted => "not judged: the run was stopped before its end".to_owned(),
        None => match first_open(criteria) {
            Some(reason) => format!("not judged: {reason}"),
            None => "not judged: this clock measures none of the criteria".to_owned(),
        },
    }
}

/// Returns the missed, starved and safe ticks by role: `missed: controller 12; safe: follower 3`. Empty without such ticks.
pub fn tick_words(books: &Accounting) -> String {
    let words = ["missed", "starved", "safe"].into_iter().filter_map(|kind| {
        let booked = books.roles.iter().map(|(role, ticks)| {
            let count = match kind {
                "missed" => ticks.missed,
                "starved" => ticks.starved,
                _ => ticks.safe,
            };
            (role, count)
        });
        let absent = books.absent_ticks.iter().filter(|_| kind == "missed").map(|(role, ticks)| (role, *ticks));
        let counted = booked.chain(absent).filter(|(_, ticks)| *ticks > 0);
        let by_role: Vec<String> = counted.map(|(role, ticks)| format!("{role} {ticks}")).collect();
        (!by_role.is_empty()).then(|| format!("{kind}: {}", by_role.join(", ")))
    });
    words.collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::launch::summary::Judged;
    use crate::launch::{Launch, run};
    use std::sync::atomic::AtomicUsize;

    #[test]
    fn counts_are_whole_and_other_values_scientific() {
        let cases =
            [(40.0, "40", "40"), (0.0, "0", "0"), (1.2345e-6, "1.2345e-6", "1.23e-6"), (1e300, "1e300", "1.00e300")];
        for (value, all, three) in cases {
            assert_eq!((exact(value), short(value)), (all.to_owned(), three.to_owned()));
        }
        assert_eq!(exact(f64::INFINITY), "inf");
    }

    /// Returns the verdict on an undisturbed run of a scenario with these overrides, after `change` was applied to its outcome.
    fn judged(overrides: &[&str], change: impl FnOnce(&mut Outcome)) -> (Option<bool>, String, Vec<Criterion>) {
        let overrides: Vec<String> =
            ["clock=in-process"].iter().chain(overrides).map(|text| (*text).to_owned()).collect();
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        let signal = AtomicUsize::new(0);
        let mut outcome = run(&scenario, &mut Launch::new(&signal, &mut |_| {})).unwrap();
        change(&mut outcome);
        let judged = Judged::new(&scenario, &outcome);
        (judged.accepted, judged.verdict, judged.criteria)
    }

    fn ticks<'o>(outcome: &'o mut Outcome, role: &str) -> &'o mut Ticks {
        &mut outcome.reports.iter_mut().find(|report| report.role == role).unwrap().ticks
    }

    fn broken(criteria: &[Criterion]) -> Vec<(&str, Option<&str>)> {
        let broken = criteria.iter().filter(|criterion| criterion.holds == Some(false));
        broken.map(|criterion| (&*criterion.name, criterion.role.as_deref())).collect()
    }

    /// A slow controller misses 151 of 10001 ticks: more than the allowed share, stated or by default.
    #[test]
    fn more_than_the_share_of_a_roles_ticks_is_not_accepted() {
        let metrics = "accept={settled_by_s=8, sync_error_rad_s_max=1e-6}";
        for overrides in [&[][..], &[metrics]] {
            for (missed, accepted) in [(100, Some(true)), (101, Some(false)), (151, Some(false))] {
                let miss = |outcome: &mut Outcome| {
                    ticks(outcome, "controller").missed = missed;
                    ticks(outcome, "follower").starved = missed;
                };
                let (found, _, criteria) = judged(overrides, miss);
                assert_eq!(found, accepted, "{missed}: {criteria:?}");
                let expected = [("missed_ticks_max", Some("controller")), ("starved_ticks_max", Some("follower"))];
                assert_eq!(broken(&criteria), if missed > 100 { &expected[..] } else { &[] });
            }
            let (found, _, criteria) = judged(overrides, |outcome| ticks(outcome, "follower").safe = 1);
            assert_eq!((found, broken(&criteria)), (Some(false), vec![("safe_ticks_max", Some("follower"))]));
        }
    }

    /// An external role may keep counters without late ticks.
    #[test]
    fn late_ticks_are_not_judged_of_a_role_that_does_not_count_them() {
        let overrides = |clock: &str, accept: &str| [format!("clock={clock}"), format!("accept={{{accept}}}")];
        let scenario = |clock, accept| Scenario::parse(SHIPPED[0].1, "test", &overrides(clock, accept)).unwrap();
        let signal = AtomicUsize::new(0);
        let mut outcome = run(&scenario("in-process", ""), &mut Launch::new(&signal, &mut |_| {})).unwrap();
        (ticks(&mut outcome, "observer").late, ticks(&mut outcome, "follower").late) = (Some(6), None);
        for (accept, name, role, holds) in [
            ("late_ticks_max=5", "late_ticks_max", Some("observer"), Some(false)),
            ("late_ticks_max=6", "late_ticks_max", Some("observer"), None),
            ("late_ticks_max={observer=6}", "late_ticks_max.observer", None, Some(true)),
            ("late_ticks_max={follower=6}", "late_ticks_max.follower", None, None),
        ] {
            let criteria = Judged::new(&scenario("realtime", accept), &outcome).criteria;
            let criterion = criteria.iter().find(|criterion| criterion.name == name).unwrap();
            assert_eq!((criterion.role.as_deref(), criterion.holds), (role, holds), "{accept}");
            let reason = holds.is_none().then_some(Unjudged::Unbooked);
            assert_eq!(criterion.reason, reason, "{accept}");
        }
    }

    /// A share of ticks may be without a score because a role missed them, but not because sent samples were lost.
    #[test]
    fn a_metric_is_not_judged_by_ticks_that_were_not_scored() {
        let peak = "accept={peak_from_s=5, sync_error_rad_s_peak=1e-3, missed_ticks_max={}, starved_ticks_max={}}";
        let pass = |blank, lost| {
            judged(&[peak], |outcome| {
                outcome.score.metrics[0].peak_blank = blank;
                outcome.score.received[0].1 -= lost;
            })
        };
        for (blank, lost, accepted) in
            [(0, 0, Some(true)), (50, 0, Some(true)), (51, 0, None), (1, 1, None), (0, 1, Some(true))]
        {
            let (found, verdict, criteria) = pass(blank, lost);
            assert_eq!(found, accepted, "{blank} {lost}: {criteria:?}");
            let reason = accepted.is_none().then_some(Unjudged::Unscored(blank, 5001, 5.0));
            assert_eq!((&criteria[0].reason, criteria[0].value.is_some()), (&reason, true));
            assert_eq!(verdict.starts_with("not judged: "), accepted.is_none(), "{verdict}");
        }
        let stated = peak.replace("peak_from_s=5", "peak_from_s=5, unscored_ticks_max=60");
        let lose = |outcome: &mut Outcome| {
            (outcome.score.metrics[0].peak_blank, outcome.score.received[0].1) = (60, 0);
            (outcome.score.scored_ticks, outcome.score.unscored_ticks) = (9941, 60);
        };
        assert_eq!(judged(&[&stated], lose).0, Some(true));
        // Ticks after the last sample are not scored either; an exceeded limit stays exceeded, whatever is missing.
        assert_eq!(judged(&[peak], |outcome| outcome.score.scored_ticks -= 100).0, None);
        let worse = |outcome: &mut Outcome| {
            (outcome.score.metrics[0].peak_blank, outcome.score.metrics[0].peak) = (4000, Some(0.6));
        };
        assert_eq!(judged(&[peak], worse).0, Some(false));
    }
}
