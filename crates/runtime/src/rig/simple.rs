//! A rig in its smallest form: a body, an estimator, a law, and one serde struct of parameters. All else has a default.
//!
//! Must not do anything that a [`Rig`] of its own could not.

use super::{BodyInfo, Context, Estimate, FleetTruth, Measurement, Monitor, NoFleet, Picture, Rig, Truth, graphs};
use crate::config::{Checks, ConfigError, Document, keys_of};
use crate::role::{Body, Estimator, Guard, Law, Refusal, SingleBody};
use crate::sample::{Field, FieldKind, Message, Sample};
use crate::state::{Persist, Words};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::borrow::Cow;

/// A leader and a follower, or whatever [`bodies`](Self::bodies) says, of one kind.
///
/// The type itself is what a scenario says of it: its fields are the scenario's tables, with serde's defaults, and errors come
/// out with file, line, key and remedy. Every `SimpleRig` is a [`Rig`].
pub trait SimpleRig: Serialize + DeserializeOwned + Clone + Send + Sync + 'static {
    /// The kind of body.
    type Body: SingleBody + Persist;
    /// What observes the first body.
    type Estimator: Estimator<Measurement = <Self::Body as Body>::Measurement> + Persist;
    /// What drives a driven body.
    type Law: Law<
            Estimate = <Self::Estimator as Estimator>::Estimate,
            Measurement = <Self::Body as Body>::Measurement,
            Command = <Self::Body as Body>::Command,
        > + Persist;
    /// By which a scenario's key `rig` names it.
    const NAME: &'static str;
    /// Those of the type's fields that a scenario gives as a list of tables.
    const LISTS: &'static [&'static str] = &[];
    /// What a run is scored by.
    const METRICS: &'static [Difference];

    /// Notes what makes no sense, by its key; may keep what it must know of the scenario.
    fn check(&mut self, _context: Context, _checks: &mut Checks<'_>) {}
    /// The bodies; the first is the observed one.
    fn bodies(&self) -> &[BodyInfo] {
        const PAIR: [BodyInfo; 2] = [
            BodyInfo { name: Cow::Borrowed("leader"), driven: false, fleet: None },
            BodyInfo { name: Cow::Borrowed("follower"), driven: true, fleet: None },
        ];
        &PAIR
    }
    /// A body at its initial state.
    fn body(&self, index: usize) -> Self::Body;
    /// The observer at its initial guess.
    fn estimator(&self) -> Self::Estimator;
    /// The law of a driven body.
    fn law(&self, index: usize) -> Self::Law;
    /// How large a field can be, in every sample that has it: what is larger is not believed, nor what is not a number.
    fn bounds(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }
    /// What the controller can watch.
    fn monitors() -> &'static [Monitor<Self>] {
        &[]
    }
    /// What a report draws of the motion.
    fn pictures() -> Vec<Picture> {
        graphs::<Truth<Self>>()
    }
}

/// A metric that is the length of a field's difference from the first body's truth.
#[derive(Debug, Clone, Copy)]
pub struct Difference {
    metric: &'static str,
    field: &'static str,
    of: Of,
}

#[derive(Debug, Clone, Copy)]
enum Of {
    Driven,
    Estimate,
}

impl Difference {
    /// How far a field of the worst driven body's truth is from that of the first body. The metric's unit is its last part.
    pub const fn following(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, of: Of::Driven }
    }

    /// How far a field of the estimate is from the truth. The metric's unit is its last part.
    pub const fn estimating(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, of: Of::Estimate }
    }

    /// Checked when a program is built: a field that the samples do not have is a mistake of the rig.
    const fn exists(&self, truth: &[Field], estimate: &[Field]) -> bool {
        has(truth, self.field) && (matches!(self.of, Of::Driven) || has(estimate, self.field))
    }
}

/// Whether there are numbers of this name.
const fn has(fields: &[Field], name: &str) -> bool {
    match field_named(fields, name) {
        Some(index) => matches!(fields[index].kind, FieldKind::F64),
        None => false,
    }
}

/// Which of the fields has a name, known when a program is built.
pub(crate) const fn field_named(fields: &[Field], name: &str) -> Option<usize> {
    let mut index = 0;
    while index < fields.len() {
        if same(fields[index].name.as_bytes(), name.as_bytes()) {
            return Some(index);
        }
        index += 1;
    }
    None
}

const fn same(one: &[u8], other: &[u8]) -> bool {
    let mut index = 0;
    while index < one.len() && index < other.len() && one[index] == other[index] {
        index += 1;
    }
    index == one.len() && index == other.len()
}

/// The numbers of a sample's field.
fn numbers<'a, S: Sample>(sample: &'a S, name: &str) -> &'a [f64] {
    let field = S::FIELDS.iter().find(|field| field.name == name);
    let (from, count) = field.map_or((0, 0), |field| (field.offset / size_of::<f64>(), field.count));
    bytemuck::cast_slice(&sample.words()[from..from + count])
}

fn distance(one: &[f64], other: &[f64]) -> f64 {
    libm::sqrt(one.iter().zip(other).map(|(one, other)| (one - other) * (one - other)).sum())
}

/// Believes samples whose numbers are numbers, within their bounds.
#[derive(Debug, Clone)]
pub struct Bounded {
    /// Word and largest magnitude of every number.
    bounds: Vec<(usize, f64)>,
}

impl Bounded {
    fn new<S: Sample>(bounds: &[(&'static str, f64)]) -> Self {
        let of = |field: &Field| {
            let bound = bounds.iter().find(|(name, _)| *name == field.name).map_or(f64::MAX, |(_, bound)| *bound);
            let first = field.offset / size_of::<f64>();
            (first..first + field.count).map(move |word| (word, bound))
        };
        let numbers = S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64);
        Self { bounds: numbers.flat_map(of).collect() }
    }
}

impl<S: Message + ?Sized> Guard<S> for Bounded {
    #[inline]
    fn accepts(&mut self, sample: &S) -> bool {
        let words = sample.words();
        self.bounds.iter().all(|(word, bound)| f64::from_bits(words[*word]).abs() <= *bound)
    }

    fn refusal(&self, sample: &S) -> Refusal {
        let words = sample.words();
        let refused = self.bounds.iter().map(|(word, _)| f64::from_bits(words[*word])).find(|value| !value.is_finite());
        refused.map_or(Refusal::OutOfRange, |_| Refusal::NotFinite)
    }
}

impl Persist for Bounded {
    fn persist<W: Words>(&mut self, _words: &mut W) {}
}

/// A rig's metrics name fields that its samples have.
struct Declared<R>(R);

impl<R: SimpleRig> Declared<R> {
    const EXIST: () = {
        let mut index = 0;
        while index < R::METRICS.len() {
            let exists = R::METRICS[index].exists(<Truth<R> as Sample>::FIELDS, <Estimate<R> as Sample>::FIELDS);
            assert!(exists, "a metric of this rig names a field that its samples do not have");
            index += 1;
        }
    };
}

impl<R: SimpleRig> Rig for R {
    type Body = R::Body;
    type Estimator = R::Estimator;
    type Law = R::Law;
    type MeasurementGuard = Bounded;
    type EstimateGuard = Bounded;
    type CommandGuard = Bounded;
    type Fleet = NoFleet;
    const NAMES: &'static [&'static str] = &[R::NAME];
    const LISTS: &'static [&'static str] = R::LISTS;

    fn tables() -> Vec<&'static str> {
        keys_of::<R>().iter().copied().filter(|field| !R::LISTS.contains(field)).collect()
    }

    fn resolve(
        _name: &str,
        sections: &Document,
        context: Context,
        checks: &mut Checks<'_>,
    ) -> Result<(Option<Self>, toml::Table), ConfigError> {
        let mut rig: R = sections.read_into()?;
        rig.check(context, checks);
        let table = toml::Table::try_from(&rig).map_err(|error| {
            let reason = format!("its parameters cannot be written as TOML: {error}");
            ConfigError::invalid(sections.place(""), R::NAME, "not-toml", reason)
        })?;
        Ok((Some(rig), table))
    }

    fn bodies(&self) -> &[BodyInfo] {
        SimpleRig::bodies(self)
    }

    fn body(&self, index: usize) -> Self::Body {
        SimpleRig::body(self, index)
    }

    fn estimator(&self) -> Self::Estimator {
        SimpleRig::estimator(self)
    }

    fn law(&self, index: usize) -> Self::Law {
        SimpleRig::law(self, index)
    }

    fn measurement_guard(&self, _index: usize, _acts: bool) -> Bounded {
        Bounded::new::<Measurement<Self>>(&self.bounds())
    }

    fn estimate_guard(&self) -> Bounded {
        Bounded::new::<Estimate<Self>>(&self.bounds())
    }

    fn command_guard(&self, _index: usize) -> Bounded {
        Bounded::new::<super::Command<Self>>(&self.bounds())
    }

    fn limits(&self) -> Vec<super::Figure> {
        let figure = |(field, bound): (&str, f64)| super::Figure { name: format!("|{field}|"), value: bound };
        self.bounds().into_iter().map(figure).collect()
    }

    fn monitors() -> &'static [Monitor<Self>] {
        <R as SimpleRig>::monitors()
    }

    fn metrics(&self) -> Vec<&'static str> {
        R::METRICS.iter().map(|difference| difference.metric).collect()
    }

    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a Truth<Self>>,
        _fleet: impl Fn(usize) -> Option<&'a FleetTruth<Self>>,
        estimate: Option<&Estimate<Self>>,
        out: &mut [f64],
    ) {
        let () = Declared::<R>::EXIST;
        for (value, Difference { field, of, .. }) in out.iter_mut().zip(R::METRICS) {
            let from = |to: Option<&[f64]>| match (to, truth(0)) {
                (Some(to), Some(first)) => distance(to, numbers(first, field)),
                _ => f64::NAN,
            };
            *value = match of {
                Of::Estimate => from(estimate.map(|estimate| numbers(estimate, field))),
                Of::Driven => {
                    let bodies = SimpleRig::bodies(self).iter().enumerate().filter(|(_, body)| body.driven);
                    let errors = bodies.map(|(index, _)| from(truth(index).map(|truth| numbers(truth, field))));
                    errors.reduce(|a, b| if a.is_nan() || a > b { a } else { b }).unwrap_or(f64::NAN)
                }
            };
        }
    }

    fn pictures() -> Vec<Picture> {
        <R as SimpleRig>::pictures()
    }
}
