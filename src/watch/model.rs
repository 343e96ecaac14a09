//! The content of the screen: roles, errors over time, events and signals. Without bus and terminal.
//!
//! Must not lose a peak: an entry that stands for several values keeps the largest.

use super::tune::TuneView;
use crate::late::LateStatus;
use crate::runtime::PaceStatus;
use crate::sample::RoleState;
use crate::telemetry::{quantile, sorted};
use std::collections::VecDeque;

/// The largest number of entries of a history. When it is reached, each pair is merged into one.
const HISTORY: usize = 256;
/// The largest number of events that are kept.
const EVENTS: usize = 100;
/// The number of latencies of which percentiles are computed.
const WINDOW: usize = 4096;
/// The time over which a tick rate is computed, s.
const RATE_S: f64 = 1.0;

/// The content of the screen.
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// The scenario's name.
    pub scenario: String,
    /// The name of the clock.
    pub clock: &'static str,
    /// The domain's directory.
    pub domain: String,
    /// The newest tick of which a sample was received.
    pub tick: u64,
    /// The last tick of the run.
    pub last_tick: u64,
    /// The period, s.
    pub tick_s: f64,
    /// True once the run has ended.
    pub ended: bool,
    /// True while the screen is paused.
    pub paused: bool,
    /// The roles, in the order of a tick.
    pub roles: Vec<RoleLine>,
    /// The late ticks, in real time.
    pub late: Option<LateStatus>,
    /// The relation of the grid to the device that sets the pace, if one does.
    pub pace: Option<PaceStatus>,
    /// The errors, and V if the law has one.
    pub series: Vec<Series>,
    /// The events, the newest last.
    pub events: VecDeque<Event>,
    /// The number of injected faults of the scenario.
    pub scripted: usize,
    /// The signals.
    pub signals: Vec<SignalLine>,
    /// The index of the selected signal.
    pub selected: usize,
    /// The index of the first visible field of the selected signal.
    pub scroll: usize,
    /// The inputs, while they are shown in the place of the signals.
    pub tune: Option<TuneView>,
}

/// The line of a role.
#[derive(Debug, Clone)]
pub struct RoleLine {
    /// The name.
    pub name: String,
    /// The state.
    pub state: RoleState,
    /// The generation, from 1; 0 before the first heartbeat.
    pub generation: u64,
    /// The next tick that it will execute.
    pub tick: u64,
    /// The number of missed ticks.
    pub missed: u64,
    /// The number of denied privileges.
    pub denied: u64,
    /// The tick rate.
    pub rate: Rate,
    /// Times from the due time of a tick until its sample was sent.
    pub lateness: Window,
    /// Times from the sending of an input until the output was sent.
    pub step: Window,
}

impl RoleLine {
    /// Returns the line of a role that has not reported yet.
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

/// The rate of a counter.
#[derive(Debug, Clone, Default)]
pub struct Rate {
    seen: VecDeque<(f64, u64)>,
}

impl Rate {
    /// Adds a count at a time, s.
    pub fn push(&mut self, time_s: f64, count: u64) {
        // The counter of another implementation may restart at zero.
        if self.seen.back().is_some_and(|(_, last)| count < *last) {
            self.seen.clear();
        }
        self.seen.push_back((time_s, count));
        while self.seen.get(1).is_some_and(|(second_s, _)| time_s - second_s > RATE_S) {
            self.seen.pop_front();
        }
    }

    /// Returns the rate per second; `None` until the counts span 0.1 s.
    pub fn per_s(&self) -> Option<f64> {
        let ((from_s, from), (to_s, to)) = (self.seen.front()?, self.seen.back()?);
        (to_s - from_s > 0.1).then(|| (to - from) as f64 / (to_s - from_s))
    }
}

/// The most recent latencies of one kind, ns. Negative ones mean that the stamps have different clocks.
#[derive(Debug, Clone, Default)]
pub struct Window {
    values: VecDeque<i64>,
}

impl Window {
    /// Adds the latency between two stamps.
    pub fn push(&mut self, from_ns: u64, to_ns: u64) {
        if self.values.len() == WINDOW {
            self.values.pop_front();
        }
        self.values.push_back(to_ns.wrapping_sub(from_ns) as i64);
    }

    /// Returns the largest negative latency as a positive number, µs; `None` if no latency is negative.
    pub fn ahead_us(&self) -> Option<f64> {
        self.values.iter().min().filter(|ns| **ns < 0).map(|ns| ns.unsigned_abs() as f64 / 1e3)
    }

    /// Returns the 50 % and 99 % percentiles, µs. They are valid only if no latency is [negative](Self::ahead_us).
    pub fn percentiles_us(&self) -> Option<[f64; 2]> {
        let sorted = sorted(self.values.iter().map(|ns| *ns as f64 / 1e3));
        Some([quantile(&sorted, 0.5)?, quantile(&sorted, 0.99)?])
    }
}

/// A quantity over time.
#[derive(Debug, Clone)]
pub struct Series {
    /// The name, with the unit as its suffix.
    pub name: String,
    /// The last value; NaN before the first.
    pub last: f64,
    /// All values.
    pub history: History,
}

impl Series {
    /// Returns a series without values.
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), last: f64::NAN, history: History::default() }
    }

    /// Adds a value; ignores NaN.
    pub fn push(&mut self, value: f64) {
        if !value.is_nan() {
            self.last = value;
            self.history.push(value);
        }
    }
}

/// Values over time in bounded memory. An entry is the largest of several values; the number per entry grows with time.
#[derive(Debug, Clone)]
pub struct History {
    values: Vec<f64>,
    /// The number of values per entry.
    per_entry: u64,
    /// The number of values in the last entry.
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

    /// Returns the largest value in each of at most `count` intervals of equal length.
    pub fn maxima(&self, count: usize) -> Vec<f64> {
        let per = self.values.len().div_ceil(count.max(1)).max(1);
        self.values.chunks(per).map(|values| values.iter().copied().fold(f64::NEG_INFINITY, f64::max)).collect()
    }

    /// Returns the exponents of the decades that contain all positive values; `None` without a positive value.
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

/// An event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// The tick at which it was detected.
    pub tick: u64,
    /// The description.
    pub text: String,
}

impl Model {
    /// Adds an event; drops the oldest one if there are too many.
    pub fn add_event(&mut self, tick: u64, text: String) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back(Event { tick, text });
    }

    /// Moves the selection by the given number of signals, and wraps around.
    pub fn select(&mut self, by: isize) {
        let count = self.signals.len().max(1) as isize;
        self.selected = (self.selected as isize + by).rem_euclid(count) as usize;
        self.scroll = 0;
    }

    /// Scrolls the fields of the selected signal by the given number.
    pub fn scroll(&mut self, by: isize) {
        let fields = self.signals.get(self.selected).map_or(0, |signal| signal.fields.len());
        self.scroll = self.scroll.saturating_add_signed(by).min(fields.saturating_sub(1));
    }
}

/// A signal with its fields as text.
#[derive(Debug, Clone, Default)]
pub struct SignalLine {
    /// `body/signal`.
    pub name: String,
    /// The name and value of every field of the newest sample; empty before the first.
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
        let maxima = history.maxima(40);
        assert!(maxima.len() <= 40 && maxima.len() > 20, "{}", maxima.len());
        let peak = maxima.iter().position(|value| *value == 7.0).unwrap() as f64;
        assert!((peak / maxima.len() as f64 - 0.543).abs() < 0.05, "the peak keeps its position");
        assert_eq!(maxima.iter().filter(|value| **value == 7.0).count(), 1);
        assert_eq!(history.decades(), Some((-9, 1)));
    }

    #[test]
    fn decades_contain_all_positive_values() {
        let mut series = Series::new("x_s");
        assert_eq!(series.history.decades(), None);
        for value in [0.0, f64::NAN, f64::INFINITY, 0.02] {
            series.push(value);
        }
        assert_eq!((series.history.decades(), series.last), (Some((-2, -1)), 0.02));
        series.push(f64::NAN);
        assert_eq!(series.last, 0.02, "NaN is ignored");
    }

    #[test]
    fn percentiles_are_of_the_last_values() {
        let mut window = Window::default();
        assert!(window.percentiles_us().is_none());
        (1..=100).for_each(|us| window.push(0, us * 1000));
        assert_eq!(window.percentiles_us(), Some([50.0, 99.0]));
        (0..WINDOW).for_each(|_| window.push(0, 3000));
        assert_eq!(window.percentiles_us(), Some([3.0, 3.0]), "old values are dropped");
        assert_eq!(window.ahead_us(), None);
        window.push(1_000_500, 500);
        assert_eq!(window.ahead_us(), Some(1000.0), "the sender has another clock");
    }

    #[test]
    fn a_rate_is_over_the_last_second() {
        let mut rate = Rate::default();
        rate.push(0.0, 0);
        assert!(rate.per_s().is_none());
        (1..=300).for_each(|k| rate.push(f64::from(k) * 0.01, if k < 100 { 0 } else { 10 * (k as u64 - 100) }));
        assert!((rate.per_s().unwrap() - 1000.0).abs() < 1e-6);
        rate.push(3.01, 5);
        assert!(rate.per_s().is_none(), "a smaller count restarts the rate");
    }

    #[test]
    fn the_selection_wraps_around() {
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
