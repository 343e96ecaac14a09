//! The `[[fault]]` tables of a scenario: as typed, with their checks, and as the runtime acts on them.
//!
//! Must refuse a fault that would do nothing, or something else than its author meant.

mod occurrence;
mod raw;

pub(crate) use raw::RawFault;

use super::body::{BodyInfo, role_names};
use super::checks::Checks;
use super::nearest;
use crate::bus::{Port, Signal};
use crate::fault::{self, Action, Change, ContentFault, Fault, Interruption, Transport, WordRange};
use crate::sample::FieldKind;
use raw::Kind;

/// The most faults of one scenario.
const MAX_FAULTS: usize = 64;
/// The longest stall, ms.
const MAX_STALL_MS: f64 = 60_000.0;
/// The field whose bits tell which components of a sample are measured or observed.
const VALID: &str = "valid";

/// A scripted fault of a scenario, and where it acts.
#[derive(Debug, Clone, PartialEq)]
pub struct ScriptedFault {
    /// The role.
    pub role: String,
    /// The body of whose signal a sample is concerned: a plant's measurement, the observer's estimate, the controller's
    /// command. None for a fault of the role itself.
    pub body: Option<String>,
    /// What happens, and when.
    pub fault: Fault,
}

/// What faults are checked against.
pub(crate) struct Setting<'a> {
    pub bodies: &'a [BodyInfo],
    /// The signals of the bodies.
    pub signals: &'a [Port],
    /// The number of components, counted from the first, of which the `valid` word of measurements and estimates tells.
    pub axes: usize,
    pub last_tick: u64,
    pub seed: u64,
    pub actuation_delay_ticks: u64,
}

/// Checks all faults of a scenario. What is refused is noted and left out.
pub(crate) fn resolve(raw: &[RawFault], setting: &Setting<'_>, checks: &mut Checks<'_>) -> Vec<ScriptedFault> {
    checks.require(raw.len() <= MAX_FAULTS, "fault", "too-many", || {
        format!(
            "{} are more than a run takes; give at most {MAX_FAULTS}, with longer ticks or a probability",
            raw.len()
        )
    });
    let each = raw.iter().enumerate().map(|(number, raw)| One { raw, number, setting, checks }.resolve());
    each.flatten().flatten().collect()
}

/// One fault being checked.
struct One<'a, 'c, 'd> {
    raw: &'a RawFault,
    number: usize,
    setting: &'a Setting<'a>,
    checks: &'c mut Checks<'d>,
}

impl One<'_, '_, '_> {
    fn key(&self, name: &str) -> String {
        format!("fault[{}].{name}", self.number)
    }

    fn require(&mut self, holds: bool, name: &str, code: &'static str, reason: impl FnOnce() -> String) -> Option<()> {
        let key = self.key(name);
        self.checks.require(holds, &key, code, reason);
        holds.then_some(())
    }

    /// One fault per signal that it acts on: a controller has several.
    fn resolve(mut self) -> Option<Vec<ScriptedFault>> {
        self.check_keys();
        self.check_time();
        let (bodies, occurrence) = (self.bodies(), self.occurrence());
        let (bodies, occurrence) = (bodies?, occurrence?);
        let RawFault { from_tick, ticks, .. } = *self.raw;
        let seed = fault::seed(self.setting.seed, self.number as u64);
        let mut faults = Vec::new();
        for (index, body) in (0..).zip(bodies) {
            // A fleet's samples have other fields than a single body's.
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

    /// Keys that mean nothing for the kind, and such that it cannot do without.
    fn check_keys(&mut self) {
        use Kind::{BitFlip, Delay, Freeze, Infinite, LostAxis, NoiseBurst, NotANumber, OutOfRange, Stall};
        let raw = self.raw;
        let of = |kinds: &[Kind]| kinds.contains(&raw.kind);
        let content = of(&[Freeze, NotANumber, Infinite, OutOfRange, BitFlip, NoiseBurst]);
        for (name, given, wanted, needed) in [
            ("body", raw.body.is_some(), !self.of_role(), false),
            ("field", raw.field.is_some(), content, false),
            ("component", raw.component.is_some(), content || of(&[LostAxis]), of(&[LostAxis])),
            ("value", raw.value.is_some(), of(&[OutOfRange]), of(&[OutOfRange])),
            ("bit", raw.bit.is_some(), of(&[BitFlip]), false),
            ("deviation", raw.deviation.is_some(), of(&[NoiseBurst]), of(&[NoiseBurst])),
            ("delay_ticks", raw.delay_ticks.is_some(), of(&[Delay]), of(&[Delay])),
            ("jitter_ticks", raw.jitter_ticks.is_some(), of(&[Delay]), false),
            ("distribution", raw.distribution.is_some(), of(&[Delay]), false),
            ("spread_ticks", raw.spread_ticks.is_some(), of(&[Delay]), false),
            ("stall_ms", raw.stall_ms.is_some(), of(&[Stall]), of(&[Stall])),
        ] {
            self.require(wanted || !given, name, "unused-key", || "has no meaning for this kind; remove it".to_owned());
            self.require(given || !needed, name, "missing-key", || "is missing for this kind; add it".to_owned());
        }
    }

    fn check_time(&mut self) {
        let raw = self.raw;
        self.require(raw.ticks >= 1, "ticks", "out-of-range", || {
            "0 ticks are none; give at least 1, or remove the fault".to_owned()
        });
        if raw.kind == Kind::Freeze {
            self.require(raw.from_tick >= 1, "from_tick", "out-of-range", || {
                "at tick 0 there is nothing to stay at; give 1 or more".into()
            });
        }
    }

    /// The bodies whose signals are concerned; none, once, for a fault of the role itself.
    fn bodies(&mut self) -> Option<Vec<Option<String>>> {
        let (raw, bodies) = (self.raw, self.setting.bodies);
        let driven: Vec<&str> = bodies.iter().filter(|body| body.driven).map(|body| &*body.name).collect();
        let roles = role_names(bodies);
        self.require(roles.contains(&&*raw.role), "role", "unknown-role", || {
            format!("there is no role `{}` in this scenario; {}", raw.role, nearest(&raw.role, &roles))
        })?;
        if self.of_role() {
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
            "is for the controller, which has a command for each driven body; remove it".to_owned()
        })?;
        let body = if raw.role == "observer" { &*bodies[0].name } else { &*raw.role };
        Some(vec![Some(body.to_owned())])
    }

    /// What happens to the samples about this body, or to the role itself.
    fn action(&mut self, body: Option<&str>) -> Option<Action> {
        let raw = self.raw;
        Some(match raw.kind {
            Kind::Drop => Action::Transport(Transport::Drop),
            Kind::Duplicate => Action::Transport(Transport::Duplicate),
            Kind::Delay => Action::Transport(Transport::Delay(self.delay()?)),
            Kind::Stall => {
                let ms = raw.stall_ms?;
                self.require(ms > 0.0 && ms <= MAX_STALL_MS, "stall_ms", "out-of-range", || {
                    format!("{ms} ms is no stall; give a number above 0, up to {MAX_STALL_MS}")
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

    /// The fields of what the role sends about a body.
    fn fields(&self, body: &str) -> Option<Fields> {
        let signal = match &*self.raw.role {
            "observer" => Signal::Estimate,
            "controller" => Signal::Command,
            _ => Signal::Measurement,
        };
        let port = self.setting.signals.iter().find(|port| port.topic.body == body && port.topic.signal == signal)?;
        // A fleet's samples have no word for all of its bodies' components, nor have commands.
        let has_axes = !port.fleet && signal != Signal::Command;
        Some(Fields::of(port, if has_axes { self.setting.axes } else { 0 }))
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
            "belongs to the stamp, of which only bits can flip; use kind = \"bit-flip\" or another field".to_owned()
        })?;
        self.require(!number || kind == FieldKind::F64, "field", "wrong-field", || {
            "is a word of bits and holds no number; use kind = \"bit-flip\" or \"freeze\", or another field".to_owned()
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

    /// The words of the field and component that are named; by default the first field, and all of its components.
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
            "takes an axis out of what is measured or estimated, and this signal is neither; name a body or the observer"
                .to_owned()
        })?;
        let (_, valid, _) = *valid?;
        self.require((1..=fields.axes).contains(&component), "component", "no-such-component", || {
            format!("there is no axis {component} to lose; give 1 to {}", fields.axes)
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
    /// The number of leading components that its `valid` word tells of.
    axes: usize,
}

impl Fields {
    fn of(port: &Port, axes: usize) -> Self {
        // In a fleet's sample the fields of the whole precede the vectors.
        let first = port.fields.iter().find(|field| field.kind == FieldKind::F64).map_or(VALID, |field| field.name);
        let names = port.fields.iter().map(|field| field.name).chain(["tick", "generation"]);
        let all = names.filter_map(|name| fault::field(&port.fields, name).map(|(words, kind)| (name, words, kind)));
        Self { all: all.collect(), first, content: WordRange::content(port.size), axes }
    }
}
