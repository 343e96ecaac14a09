//! What there is to see of a run: roles, errors over time, events, signals. Without bus and terminal.
//!
//! Must not forget a peak: what is drawn narrower than it was seen keeps the largest value.

use crate::sample::RoleState;
use crate::telemetry::{quantile, sorted};
use std::collections::VecDeque;

/// Values that a history keeps at the most; beyond it two become one.
const HISTORY: usize = 256;
/// Events that are kept.
const EVENTS: usize = 100;
/// Latencies by which percentiles are told: the last ones.
const WINDOW: usize = 4096;
/// The time over which a tick rate is told, s.
const RATE_S: f64 = 1.0;

/// Everything on the screen.
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// The scenario's name.
    pub scenario: String,
    /// Its clock's name.
    pub clock: &'static str,
    /// The domain's directory.
    pub domain: String,
    /// The last tick that something was seen of, and the last of the run.
    pub tick: u64,
    /// The last tick of the run.
    pub last_tick: u64,
    /// The period, s.
    pub tick_s: f64,
    /// Whether the run is over, or gone.
    pub ended: bool,
    /// Whether the screen stands still.
    pub paused: bool,
    /// The roles, in the order of a tick.
    pub roles: Vec<RoleLine>,
    /// Errors, and V where there is one.
    pub series: Vec<Series>,
    /// What happened, the newest last.
    pub events: VecDeque<Event>,
    /// Scripted faults of the scenario.
    pub scripted: usize,
    /// The signals.
    pub signals: Vec<SignalLine>,
    /// The selected one.
    pub selected: usize,
    /// The first field of it that is shown.
    pub scroll: usize,
}

/// One role.
#[derive(Debug, Clone)]
pub struct RoleLine {
    /// Its name.
    pub name: String,
    /// Where it stands.
    pub state: RoleState,
    /// Its life, from 1; 0 before it has spoken.
    pub generation: u64,
    /// The next tick that it will execute.
    pub tick: u64,
    /// Ticks missed.
    pub missed: u64,
    /// Privileges that it was denied.
    pub denied: u64,
    /// Ticks executed over time.
    pub rate: Rate,
    /// From when its tick was due until its sample was sent.
    pub lateness: Window,
    /// From when its input was sent until its own sample was.
    pub step: Window,
}

impl RoleLine {
    /// A role that nothing is known of.
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            state: RoleState::Absent,
            generation: 0,
            tick: 0,
            missed: 0,
            denied: 0,
            rate: Rate::default(),
            lateness: Window::default(),
            step: Window::default(),
        }
    }
}

/// How fast a count grows.
#[derive(Debug, Clone, Default)]
pub struct Rate {
    seen: VecDeque<(f64, u64)>,
}

impl Rate {
    /// Takes a count at a time, s.
    pub fn push(&mut self, time_s: f64, count: u64) {
        // A successor of another kind may begin anew: what fell is no rate.
        if self.seen.back().is_some_and(|(_, last)| count < *last) {
            self.seen.clear();
        }
        self.seen.push_back((time_s, count));
        while self.seen.get(1).is_some_and(|(second_s, _)| time_s - second_s > RATE_S) {
            self.seen.pop_front();
        }
    }

    /// Per second; none before two counts are far enough apart.
    pub fn per_s(&self) -> Option<f64> {
        let ((from_s, from), (to_s, to)) = (self.seen.front()?, self.seen.back()?);
        (to_s - from_s > 0.1).then(|| (to - from) as f64 / (to_s - from_s))
    }
}

/// The last latencies of one kind, ns; negative ones too: then the stamps are not of one clock.
#[derive(Debug, Clone, Default)]
pub struct Window {
    values: VecDeque<i64>,
}

impl Window {
    /// Takes the one between two stamps.
    pub fn push(&mut self, from_ns: u64, to_ns: u64) {
        if self.values.len() == WINDOW {
            self.values.pop_front();
        }
        self.values.push_back(to_ns.wrapping_sub(from_ns) as i64);
    }

    /// The most by which the stamp that should be the earlier one lies ahead, µs; none if it never does.
    pub fn ahead_us(&self) -> Option<f64> {
        self.values.iter().min().filter(|ns| **ns < 0).map(|ns| ns.unsigned_abs() as f64 / 1e3)
    }

    /// The median and what 99 % are at most, µs. Of use only where no stamp lies [ahead](Self::ahead_us).
    pub fn percentiles_us(&self) -> Option<[f64; 2]> {
        let sorted = sorted(self.values.iter().map(|ns| *ns as f64 / 1e3));
        Some([quantile(&sorted, 0.5)?, quantile(&sorted, 0.99)?])
    }
}

/// A quantity over the time that was watched.
#[derive(Debug, Clone)]
pub struct Series {
    /// Its name; the unit is its last part.
    pub name: String,
    /// The last value; NaN before the first.
    pub last: f64,
    /// All of them.
    pub history: History,
}

impl Series {
    /// One without values.
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), last: f64::NAN, history: History::default() }
    }

    /// Takes a value; one that is no number is none.
    pub fn push(&mut self, value: f64) {
        if !value.is_nan() {
            self.last = value;
            self.history.push(value);
        }
    }
}

/// Values over time in bounded memory: the longer it lasts, the more values one entry stands for, by their largest.
#[derive(Debug, Clone)]
pub struct History {
    values: Vec<f64>,
    /// Values per entry, and those in the last one.
    per_entry: u64,
    in_last: u64,
}

impl Default for History {
    fn default() -> Self {
        Self { values: Vec::new(), per_entry: 1, in_last: 1 }
    }
}

impl History {
    fn push(&mut self, value: f64) {
        if self.in_last < self.per_entry
            && let Some(last) = self.values.last_mut()
        {
            *last = last.max(value);
            self.in_last += 1;
            return;
        }
        if self.values.len() == HISTORY {
            let pairs = self.values.chunks(2).map(|pair| pair.iter().copied().fold(f64::NEG_INFINITY, f64::max));
            self.values = pairs.collect();
            self.per_entry *= 2;
        }
        self.values.push(value);
        self.in_last = 1;
    }

    /// The largest values in so many stretches of equal length, the last one now; fewer if there are fewer.
    pub fn stretches(&self, count: usize) -> Vec<f64> {
        let per = self.values.len().div_ceil(count.max(1)).max(1);
        self.values.chunks(per).map(|values| values.iter().copied().fold(f64::NEG_INFINITY, f64::max)).collect()
    }

    /// The decades that hold all values: exponents of ten, at least one apart; none without a positive value.
    pub fn decades(&self) -> Option<(i32, i32)> {
        let positive = || self.values.iter().copied().filter(|value| *value > 0.0 && value.is_finite());
        let (low, high) = (positive().fold(f64::INFINITY, f64::min), positive().fold(0.0, f64::max));
        if high == 0.0 {
            return None;
        }
        let (low, high) = (low.log10().floor() as i32, high.log10().ceil() as i32);
        Some((low, high.max(low + 1)))
    }
}

/// Something that happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// At which tick it was seen.
    pub tick: u64,
    /// What.
    pub text: String,
}

impl Model {
    /// Takes an event.
    pub fn happened(&mut self, tick: u64, text: String) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back(Event { tick, text });
    }

    /// Selects the signal so many after this one.
    pub fn select(&mut self, by: isize) {
        let count = self.signals.len().max(1) as isize;
        self.selected = (self.selected as isize + by).rem_euclid(count) as usize;
        self.scroll = 0;
    }

    /// Scrolls through the fields of the selected signal.
    pub fn scroll(&mut self, by: isize) {
        let fields = self.signals.get(self.selected).map_or(0, |signal| signal.fields.len());
        self.scroll = self.scroll.saturating_add_signed(by).min(fields.saturating_sub(1));
    }
}

/// One signal, with its fields as text.
#[derive(Debug, Clone, Default)]
pub struct SignalLine {
    /// `body/signal`.
    pub name: String,
    /// Name and value of every field of the last sample; empty before the first.
    pub fields: Vec<(String, String)>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_history_keeps_every_peak_in_bounded_memory() {
        let mut history = History::default();
        for index in 0..100_000 {
            history.push(if index == 54_321 { 7.0 } else { 1e-9 });
        }
        assert!(history.values.len() <= HISTORY);
        let stretches = history.stretches(40);
        assert!(stretches.len() <= 40 && stretches.len() > 20, "{}", stretches.len());
        let peak = stretches.iter().position(|value| *value == 7.0).unwrap() as f64;
        assert!((peak / stretches.len() as f64 - 0.543).abs() < 0.05, "it stays where it was");
        assert_eq!(stretches.iter().filter(|value| **value == 7.0).count(), 1);
        assert_eq!(history.decades(), Some((-9, 1)));
    }

    #[test]
    fn decades_hold_what_there_is() {
        let mut series = Series::new("x_s");
        assert_eq!(series.history.decades(), None);
        for value in [0.0, f64::NAN, f64::INFINITY, 0.02] {
            series.push(value);
        }
        assert_eq!((series.history.decades(), series.last), (Some((-2, -1)), 0.02));
        series.push(f64::NAN);
        assert_eq!(series.last, 0.02, "no number is no value");
    }

    #[test]
    fn percentiles_are_of_the_last_values() {
        let mut window = Window::default();
        assert!(window.percentiles_us().is_none());
        (1..=100).for_each(|us| window.push(0, us * 1000));
        assert_eq!(window.percentiles_us(), Some([50.0, 99.0]));
        (0..WINDOW).for_each(|_| window.push(0, 3000));
        assert_eq!(window.percentiles_us(), Some([3.0, 3.0]), "the old ones are gone");
        assert_eq!(window.ahead_us(), None);
        window.push(1_000_500, 500);
        assert_eq!(window.ahead_us(), Some(1000.0), "the sender's clock is another");
    }

    #[test]
    fn a_rate_is_over_the_last_second() {
        let mut rate = Rate::default();
        rate.push(0.0, 0);
        assert!(rate.per_s().is_none());
        (1..=300).for_each(|k| rate.push(f64::from(k) * 0.01, if k < 100 { 0 } else { 10 * (k as u64 - 100) }));
        assert!((rate.per_s().unwrap() - 1000.0).abs() < 1e-6);
        rate.push(3.01, 5);
        assert!(rate.per_s().is_none(), "a count that fell begins anew");
    }

    #[test]
    fn selecting_goes_round() {
        let mut model = Model::default();
        model.select(1);
        assert_eq!(model.selected, 0, "there is nothing to select");
        let signal = SignalLine { name: "leader/truth".to_owned(), fields: vec![Default::default(); 3] };
        model.signals = vec![signal; 3];
        model.select(-1);
        assert_eq!(model.selected, 2);
        model.scroll(5);
        assert_eq!(model.scroll, 2);
        model.select(1);
        assert_eq!((model.selected, model.scroll), (0, 0));
    }
}
