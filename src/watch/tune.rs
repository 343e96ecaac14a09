//! The inputs on the screen: shows their values, and changes them as the user asks.
//!
//! A thread of its own talks to the launcher, so that the screen never waits. Must not check a value itself; the same check as for
//! `corotate set` does.

use crate::config::{InputInfo, Variability};
use crate::inputs::{Answer, InputError, WantedChange, change, current};
use crate::seat::scenario_of;
use ratatui::crossterm::event::{KeyCode, KeyEvent};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;
use toml::Value;

/// The interval at which the values are read.
const READ: Duration = Duration::from_millis(300);
/// The factor by which an arrow key changes a parameter, and the part of its range by which it changes a signal.
const FACTOR: f64 = 1.05;
const PART: f64 = 0.01;
/// The step of a signal without a finite range.
const STEP: f64 = 0.01;

/// The inputs as drawn.
#[derive(Debug, Clone, Default)]
pub struct TuneView {
    /// Each component with its label and its value.
    pub rows: Vec<(String, String)>,
    /// The index of the selected row.
    pub selected: usize,
    /// The number that is being typed.
    pub typed: String,
    /// The outcome of the last change.
    pub message: String,
}

/// A component of an input.
struct Row {
    info: InputInfo,
    component: usize,
}

/// The inputs of a run while they are tuned.
pub struct Tune {
    rows: Vec<Row>,
    values: BTreeMap<String, Value>,
    selected: usize,
    typed: String,
    message: String,
    /// The values before each change, the last one at the end.
    before: Vec<WantedChange>,
    changes: Sender<WantedChange>,
    news: Receiver<News>,
}

/// News of the thread that talks to the launcher.
enum News {
    Values(BTreeMap<String, Value>),
    Message(String),
}

impl Tune {
    /// Starts to tune the run in a domain's directory; `None` if its scenario cannot be read.
    pub fn start(root: &Path) -> Option<Self> {
        let scenario = scenario_of(root).ok()?;
        let rows = scenario
            .inputs
            .infos
            .iter()
            .flat_map(|info| (0..info.initial.len()).map(|component| Row { info: info.clone(), component }));
        let rows = rows.collect();
        let (changes, wanted) = channel();
        let (sender, news) = channel();
        let root = root.to_owned();
        std::thread::Builder::new().name("tune".to_owned()).spawn(move || talk(&root, &wanted, &sender)).ok()?;
        let (values, typed, message, before) = (BTreeMap::new(), String::new(), String::new(), Vec::new());
        Some(Self { rows, values, selected: 0, typed, message, before, changes, news })
    }

    /// Returns what the screen shows, with the news that have arrived.
    pub fn view(&mut self) -> TuneView {
        for news in self.news.try_iter() {
            match news {
                News::Values(values) => self.values = values,
                News::Message(message) => self.message = message,
            }
        }
        let row = |row: &Row| (row.label(), row.text(&self.values));
        let rows = self.rows.iter().map(row).collect();
        TuneView { rows, selected: self.selected, typed: self.typed.clone(), message: self.message.clone() }
    }

    /// Handles a key; returns false if it has no meaning here.
    pub fn key(&mut self, key: KeyEvent) -> bool {
        match key.code {
            KeyCode::Down | KeyCode::Tab => self.select(1),
            KeyCode::Up | KeyCode::BackTab => self.select(-1),
            KeyCode::Left => self.step(-1.0),
            KeyCode::Right => self.step(1.0),
            KeyCode::Char('u') => self.undo(),
            KeyCode::Char(letter) if letter.is_ascii_digit() || "+-.e".contains(letter) => self.typed.push(letter),
            KeyCode::Backspace => drop(self.typed.pop()),
            KeyCode::Enter => self.enter(),
            _ => return false,
        }
        true
    }

    fn select(&mut self, by: isize) {
        let count = self.rows.len().max(1);
        self.selected = self.selected.saturating_add_signed(by).min(count - 1);
        self.typed.clear();
    }

    fn enter(&mut self) {
        match std::mem::take(&mut self.typed).parse() {
            Ok(value) => self.set(value),
            Err(_) if self.rows.get(self.selected).is_some_and(Row::is_switch) => self.step(1.0),
            Err(_) => "type a number, then press Enter".clone_into(&mut self.message),
        }
    }

    /// Changes the selected component by a small step; a switch is toggled.
    fn step(&mut self, sign: f64) {
        let Some(row) = self.rows.get(self.selected) else { return };
        let Some(value) = row.value(&self.values) else { return };
        let (least, largest) = row.info.range;
        let next = match row.info.variability {
            Variability::Switch => 1.0 - value,
            Variability::Tunable => value * if sign > 0.0 { FACTOR } else { 1.0 / FACTOR },
            Variability::Input if (largest - least).is_finite() => value + sign * PART * (largest - least) / 2.0,
            Variability::Input => value + sign * STEP,
        };
        self.set(next);
    }

    /// Asks for a new value of the selected component.
    fn set(&mut self, value: f64) {
        let Some(row) = self.rows.get(self.selected) else { return };
        let Some(mut components) = row.components(&self.values) else { return };
        let key = &row.info.key;
        let change =
            |components: &[f64]| WantedChange { key: key.clone(), value: row.info.to_toml(components), ramp_s: 0.0 };
        let before = change(&components);
        components[row.component] = value;
        let wanted = change(&components);
        // Until the launcher's values are read again, further steps start from here.
        self.values.insert(key.clone(), wanted.value.clone());
        self.before.push(before);
        self.ask(wanted);
    }

    fn undo(&mut self) {
        match self.before.pop() {
            Some(before) => self.ask(before),
            None => "nothing to undo".clone_into(&mut self.message),
        }
    }

    fn ask(&mut self, change: WantedChange) {
        self.message = format!("{} = {} ...", change.key, change.value);
        if self.changes.send(change).is_err() {
            "the run has ended".clone_into(&mut self.message);
        }
    }
}

impl Row {
    fn is_switch(&self) -> bool {
        self.info.variability == Variability::Switch
    }

    fn label(&self) -> String {
        match self.info.initial.len() {
            1 => self.info.key.clone(),
            _ => format!("{}[{}]", self.info.key, self.component + 1),
        }
    }

    fn components(&self, values: &BTreeMap<String, Value>) -> Option<Vec<f64>> {
        let components = self.info.from_toml(values.get(&self.info.key)?).ok()?;
        Some(components[..self.info.initial.len()].to_vec())
    }

    fn value(&self, values: &BTreeMap<String, Value>) -> Option<f64> {
        self.components(values).map(|components| components[self.component])
    }

    fn text(&self, values: &BTreeMap<String, Value>) -> String {
        match self.value(values) {
            None => "-".to_owned(),
            Some(value) if self.is_switch() => (value != 0.0).to_string(),
            Some(value) => format!("{value:.6}"),
        }
    }
}

/// Reads the values at intervals, and asks for changes, until the other end is dropped or the run is over.
fn talk(root: &Path, wanted: &Receiver<WantedChange>, news: &Sender<News>) {
    loop {
        let asked = match wanted.recv_timeout(READ) {
            Ok(wanted) => Some(wanted),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        if let Some(wanted) = asked {
            let message = ask(root, wanted).unwrap_or_else(|error| error.to_string());
            if news.send(News::Message(message)).is_err() {
                return;
            }
        }
        match current(root) {
            Ok((_, values)) => drop(news.send(News::Values(values))),
            Err(error) => drop(news.send(News::Message(error.to_string()))),
        }
    }
}

fn ask(root: &Path, wanted: WantedChange) -> Result<String, InputError> {
    let text = format!("{} = {}", wanted.key, wanted.value);
    Ok(match change(root, vec![wanted], None, false)? {
        Answer::Accepted { tick, time_s, .. } => format!("{text} from tick {tick} ({time_s:.3} s)"),
        _ => text,
    })
}
