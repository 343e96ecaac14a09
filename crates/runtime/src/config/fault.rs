//! The `[[fault]]` tables of a scenario: as typed, their checks, and as the runtime executes them.
//!
//! Must refuse a fault that has no effect, or another effect than its author meant.

mod occurrence;
mod raw;

pub(crate) use raw::RawFault;

use super::body::{BodyInfo, role_names};
use super::checks::Checks;
use super::error::nearest;
use crate::bus::{Port, Signal};
use crate::fault::{self, Action, Change, ContentFault, Fault, Interruption, Transport, WordRange};
use crate::sample::FieldKind;
use raw::Kind;

/// The most faults of a scenario.
const MAX_FAULTS: usize = 64;
/// The longest stall, ms.
const MAX_STALL_MS: f64 = 60_000.0;
/// The field whose bits mark the components of a sample that are measured or observed.
const VALID: &str = "valid";

/// A scripted fault of a scenario, with the role and the body that it affects.
#[derive(Debug, Clone, PartialEq)]
pub struct ScriptedFault {
    /// The role.
    pub role: String,
    /// The body whose signal is affected: a plant's measurement, the observer's estimate, or the controller's command. `None` for a
    /// fault of the role itself.
    pub body: Option<String>,
    /// The effect of the fault, and its time.
    pub fault: Fault,
}

/// The scenario against which faults are checked.
pub(crate) struct Setting<'a> {
    pub bodies: &'a [BodyInfo],
    /// The signals of the bodies.
    pub signals: &'a [Port],
    /// The number of leading components covered by the `valid` word of measurements and estimates.
    pub axes: usize,
    pub last_tick: u64,
    pub seed: u64,
    pub actuation_delay_ticks: u64,
}

/// Checks all faults of a scenario. Refused faults are recorded and left out.
pub(crate) fn resolve(raw: &[RawFault], setting: &Setting<'_>, checks: &mut Checks<'_>) -> Vec<ScriptedFault> {
    checks.require(raw.len() <= MAX_FAULTS, "fault", "too-many", || {
        format!(
            "{} are more than a run takes; give at most {MAX_FAULTS}, with longer ticks or a probability",
            raw.len()
        )
    });
    let each = raw.iter().enumerate().map(|(number, raw)| FaultCheck { raw, number, setting, checks }.resolve());
    each.flatten().flatten().collect()
}

/// The check of one fault.
struct FaultCheck<'a, 'c, 'd> {
    raw: &'a RawFault,
    number: usize,
    setting: &'a Setting<'a>,
    checks: &'c mut Checks<'d>,
}

impl FaultCheck<'_, '_, '_> {
    fn key(&self, name: &str) -> String {
        format!("fault[{}].{name}", self.number)
    }

    fn require(&mut self, holds: bool, name: &str, code: &'static str, reason: impl FnOnce() -> String) -> Option<()> {
        let key = self.key(name);
        self.checks.require(holds, &key, code, reason);
        holds.then_some(())
    }

    /// Returns one fault per affected signal: a controller has several.
    fn resolve(mut self) -> Option<Vec<ScriptedFault>> {
        self.check_keys();
        self.check_time();
        let (bodies, occurrence) = (self.bodies(), self.occurrence());
        let (bodies, occurrence) = (bodies?, occurrence?);
        let RawFault { from_tick, ticks, .. } = *self.raw;
        let seed = fault::seed(self.setting.seed, self.number as u64);
        let mut faults = Vec::new();
        for (index, body) in (0..).zip(bodies) {
            // A fleet's samples have different fields from a single body's.
            let action = self.action(body.as_deref())?;
            let fault = Fault { from_tick, ticks, occurrence, seed: fault::seed(seed, index), action };
            faults.push(ScriptedFault { role: self.raw.role.clone(), body, fault });
        }
        let last_tick = self.setting.last_tick;
        if from_tick > last_tick {
            let key = self.key("from_tick");
            self.checks.warn(&key, format!("{from_tick} is after the last tick {last_tick}: the fault does not act"));
            faults.clear();
        }
        Some(faults)
    }

    /// Refuses keys without a meaning for the kind, and missing keys that it needs.
    fn check_keys(&mut self) {
        use Kind::{BitFlip, Delay, Freeze, Infinite, LostAxis, NoiseBurst, NotANumber, OutOfRange, Stall};
        let raw = self.raw;
        let is = |kinds: &[Kind]| kinds.contains(&raw.kind);
        let content = is(&[Freeze, NotANumber, Infinite, OutOfRange, BitFlip, NoiseBurst]);
        for (name, given, wanted, needed) in [
            ("body", raw.body.is_some(), !self.targets_role(), false),
            ("field", raw.field.is_some(), content, false),
            ("component", raw.component.is_some(), content || is(&[LostAxis]), is(&[LostAxis])),
            ("value", raw.value.is_some(), is(&[OutOfRange]), is(&[OutOfRange])),
            ("bit", raw.bit.is_some(), is(&[BitFlip]), false),
            ("deviation", raw.deviation.is_some(), is(&[NoiseBurst]), is(&[NoiseBurst])),
            ("delay_ticks", raw.delay_ticks.is_some(), is(&[Delay]), is(&[Delay])),
            ("jitter_ticks", raw.jitter_ticks.is_some(), is(&[Delay]), false),
            ("distribution", raw.distribution.is_some(), is(&[Delay]), false),
            ("spread_ticks", raw.spread_ticks.is_some(), is(&[Delay]), false),
            ("stall_ms", raw.stall_ms.is_some(), is(&[Stall]), is(&[Stall])),
        ] {
            self.require(wanted || !given, name, "unused-key", || "has no meaning for this kind; remove it".to_owned());
            self.require(given || !needed, name, "missing-key", || "is missing for this kind; add it".to_owned());
        }
    }

    fn check_time(&mut self) {
        let raw = self.raw;
        self.require(raw.ticks >= 1, "ticks", "out-of-range", || {
            "a fault of 0 ticks has no effect; give at least 1, or remove it".to_owned()
        });
        if raw.kind == Kind::Freeze {
            self.require(raw.from_tick >= 1, "from_tick", "out-of-range", || {
                "at tick 0 there is nothing to stay at; give 1 or more".into()
            });
        }
    }

    /// Returns the bodies whose signals are affected; a single `None` for a fault of the role itself.
    fn bodies(&mut self) -> Option<Vec<Option<String>>> {
        let (raw, bodies) = (self.raw, self.setting.bodies);
        let driven: Vec<&str> = bodies.iter().filter(|body| body.driven).map(|body| &*body.name).collect();
        let roles = role_names(bodies);
        self.require(roles.contains(&&*raw.role), "role", "unknown-role", || {
            format!("there is no role `{}` in this scenario; {}", raw.role, nearest(&raw.role, &roles))
        })?;
        if self.targets_role() {
            return Some(vec![None]);
        }
        if raw.role == "controller" {
            if let Some(body) = &raw.body {
                self.require(driven.contains(&&**body), "body", "unknown-body", || {
                    format!("the controller drives no `{body}`; {}", nearest(body, &driven))
                })?;
            }
            let wanted = |body: &&&str| raw.body.as_ref().is_none_or(|wanted| wanted == **body);
            return Some(driven.iter().filter(wanted).map(|body| Some((*body).to_owned())).collect());
        }
        self.require(raw.body.is_none(), "body", "unused-key", || {
            "is for the controller, which sends a command to each driven body; remove it".to_owned()
        })?;
        let observed = bodies.iter().find(|body| body.observer.as_ref() == Some(&raw.role));
        Some(vec![Some(observed.map_or(raw.role.clone(), |body| body.name.to_string()))])
    }

    /// Returns the fault's action on the samples about this body, or on the role itself.
    fn action(&mut self, body: Option<&str>) -> Option<Action> {
        let raw = self.raw;
        Some(match raw.kind {
            Kind::Drop => Action::Transport(Transport::Drop),
            Kind::Duplicate => Action::Transport(Transport::Duplicate),
            Kind::Delay => Action::Transport(Transport::Delay(self.delay()?)),
            Kind::Stall => {
                let ms = raw.stall_ms?;
                self.require(ms > 0.0 && ms <= MAX_STALL_MS, "stall_ms", "out-of-range", || {
                    format!("a stall of {ms} ms is out of range; give a number above 0, up to {MAX_STALL_MS}")
                })?;
                Action::Role(Interruption::Stall { ns: (ms * 1e6) as u64 })
            }
            Kind::Kill => Action::Role(Interruption::Kill),
            Kind::Miss => Action::Role(Interruption::Miss),
            _ => {
                let fields = self.fields(body?)?;
                Action::Content(self.tamper(&fields)?)
            }
        })
    }

    /// Returns the fields of the signal that the role sends about a body.
    fn fields(&self, body: &str) -> Option<Fields> {
        let observes = |body: &BodyInfo| body.observer.as_ref() == Some(&self.raw.role);
        let signal = match &*self.raw.role {
            "controller" => Signal::Command,
            _ if self.setting.bodies.iter().any(observes) => Signal::Estimate,
            _ => Signal::Measurement,
        };
        let port = self.setting.signals.iter().find(|port| port.topic.body == body && port.topic.signal == signal)?;
        // Neither fleet samples nor commands have a word for the validity of all components.
        let has_axes = !port.fleet && signal != Signal::Command;
        Some(Fields::new(port, if has_axes { self.setting.axes } else { 0 }))
    }

    fn tamper(&mut self, fields: &Fields) -> Option<ContentFault> {
        let raw = self.raw;
        if raw.kind == Kind::LostAxis {
            return self.lost_axis(fields);
        }
        if raw.kind == Kind::Freeze && raw.field.is_none() && raw.component.is_none() {
            return Some(ContentFault { change: Change::Freeze, words: fields.content });
        }
        let (words, kind) = self.words(fields)?;
        let number = !matches!(raw.kind, Kind::Freeze | Kind::BitFlip);
        let stamp = words.first < fields.content.first;
        self.require(!stamp || raw.kind == Kind::BitFlip, "field", "wrong-field", || {
            "belongs to the stamp, which accepts only bit flips; use kind = \"bit-flip\" or another field".to_owned()
        })?;
        self.require(!number || kind == FieldKind::F64, "field", "wrong-field", || {
            "is a word of bits, not a number; use kind = \"bit-flip\" or \"freeze\", or another field".to_owned()
        })?;
        let change = match raw.kind {
            Kind::Freeze => Change::Freeze,
            Kind::NotANumber => Change::Set(f64::NAN),
            Kind::Infinite => Change::Set(f64::INFINITY),
            Kind::OutOfRange => Change::Set(raw.value?),
            Kind::NoiseBurst => {
                let deviation = raw.deviation?;
                let key = self.key("deviation");
                self.checks.positive(&key, deviation);
                Change::Noise(deviation)
            }
            _ => {
                self.require(raw.bit.is_none_or(|bit| bit < 64), "bit", "out-of-range", || {
                    "a word has 64 bits; give 0 (the least significant) to 63".to_owned()
                })?;
                Change::Flip(raw.bit.map(|bit| bit as u32))
            }
        };
        Some(ContentFault { change, words })
    }

    /// Returns the words of the given field and component; by default all components of the first field.
    fn words(&mut self, fields: &Fields) -> Option<(WordRange, FieldKind)> {
        let raw = self.raw;
        let names: Vec<&str> = fields.all.iter().map(|(name, ..)| *name).collect();
        let name = raw.field.as_deref().unwrap_or(fields.first);
        let found = fields.all.iter().find(|(known, ..)| *known == name);
        self.require(found.is_some(), "field", "unknown-field", || {
            format!("the sample has no field `{name}`; {}", nearest(name, &names))
        })?;
        let (_, words, kind) = *found?;
        let Some(component) = raw.component else { return Some((words, kind)) };
        self.require((1..=words.count).contains(&component), "component", "no-such-component", || match words.count {
            1 => format!("`{name}` has one component; give 1 or leave it out"),
            count => format!("`{name}` has no component {component}; give 1 to {count}"),
        })?;
        Some((WordRange { first: words.first + component - 1, count: 1 }, kind))
    }

    fn lost_axis(&mut self, fields: &Fields) -> Option<ContentFault> {
        let component = self.raw.component?;
        let valid = fields.all.iter().find(|(name, ..)| *name == VALID);
        self.require(valid.is_some(), "kind", "wrong-signal", || {
            "removes an axis of a measurement or estimate; this signal is neither; name a body or the observer"
                .to_owned()
        })?;
        let (_, valid, _) = *valid?;
        self.require((1..=fields.axes).contains(&component), "component", "no-such-component", || {
            format!("there is no axis {component}; give 1 to {}", fields.axes)
        })?;
        let words = WordRange { first: fields.content.first + component - 1, count: 1 };
        Some(ContentFault { change: Change::Lose { valid: valid.first }, words })
    }
}

/// The words of a signal's samples.
struct Fields {
    all: Vec<(&'static str, WordRange, FieldKind)>,
    first: &'static str,
    content: WordRange,
    /// The number of leading components covered by the `valid` word.
    axes: usize,
}

impl Fields {
    fn new(port: &Port, axes: usize) -> Self {
        // In a fleet's sample the common fields precede the vectors.
        let first = port.fields.iter().find(|field| field.kind == FieldKind::F64).map_or(VALID, |field| field.name);
        let names = port.fields.iter().map(|field| field.name).chain(["tick", "generation"]);
        let all = names.filter_map(|name| fault::field(&port.fields, name).map(|(words, kind)| (name, words, kind)));
        Self { all: all.collect(), first, content: WordRange::content(port.size), axes }
    }
}
