//! The smallest form of a rig: a body, an estimator, a law, and one serde struct of parameters. Everything else has a default.
//!
//! This file does nothing that a [`Rig`] implementation could not do.

use super::BodyInfo;
use super::contract::{Command, Context, Estimate, FleetTruth, Measurement, Monitor, Rig, Truth};
use super::fleet::NoFleet;
use super::pictures::{Picture, graphs};
use crate::config::{Checks, ConfigError, Document, InputInfo, keys_of};
use crate::input::COMPONENTS_MAX;
use crate::role::{Body, Estimator, Guard, Law, REFERENCE_MAX, Refusal, SingleBody};
use crate::sample::{Field, FieldKind, Message, Sample, field_named, same_name};
use crate::state::{Persist, Words};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// A rig with one kind of body: by default a leader, which is observed, and a follower, which is driven.
///
/// The type holds the scenario's parameters: each field is a table of the scenario file, read by serde with its defaults. A
/// mistake in the file is reported with line, key and remedy. Every `SimpleRig` is a [`Rig`].
///
/// A cart moves at the commanded speed. The follower keeps beside the leader, which moves at a constant speed:
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::role::{Body, Estimator, Law, LawInputs};
/// use corotate::{persist_fields, sample};
/// use corotate_runtime::rig::{Difference, SimpleRig};
/// use corotate_runtime::scenario::{RigKind, Scenario, register};
/// use serde::{Deserialize, Serialize};
///
/// sample! { Truth = "cart/Truth/v1" { position_m: f64, speed_m_s: f64, status: u64, } }
/// sample! { Measurement = "cart/Measurement/v1" { position_m: f64, status: u64, } }
/// sample! { Estimate = "cart/Estimate/v1" { position_m: f64, status: u64, } }
/// sample! { Command = "cart/Command/v1" { speed_m_s: f64, } }
///
/// struct Cart { position_m: f64, speed_m_s: f64 }
/// persist_fields!(Cart, position_m, speed_m_s);
/// impl Body for Cart {
///     type Truth = Truth;
///     type Measurement = Measurement;
///     type Command = Command;
///     fn apply(&mut self, command: &Command) -> bool {
///         self.speed_m_s = command.speed_m_s;
///         true
///     }
///     fn apply_safe(&mut self) {
///         self.speed_m_s = 0.0;
///     }
///     fn truth(&self, status: u64, out: &mut Truth) {
///         (out.position_m, out.speed_m_s, out.status) = (self.position_m, self.speed_m_s, status);
///     }
///     fn measure(&mut self, _tick: u64, status: u64, out: &mut Measurement) {
///         (out.position_m, out.status) = (self.position_m, status);
///     }
///     fn flow(&mut self, dt_s: f64) {
///         self.position_m += self.speed_m_s * dt_s;
///     }
/// }
///
/// /// The estimate is the last measured position.
/// struct Last { position_m: f64 }
/// persist_fields!(Last, position_m);
/// impl Estimator for Last {
///     type Measurement = Measurement;
///     type Estimate = Estimate;
///     fn start(&mut self, measurement: &Measurement) {
///         self.position_m = measurement.position_m;
///     }
///     fn update(&mut self, measurement: &Measurement, _dt_s: f64) {
///         self.position_m = measurement.position_m;
///     }
///     fn write(&self, status: u64, out: &mut Estimate) {
///         (out.position_m, out.status) = (self.position_m, status);
///     }
/// }
///
/// #[derive(Clone, Serialize, Deserialize)]
/// #[serde(deny_unknown_fields)]
/// struct Parameters { leader_speed_m_s: f64, gain_per_s: f64 }
/// persist_fields!(Parameters,);
/// impl Law for Parameters {
///     type Estimate = Estimate;
///     type Measurement = Measurement;
///     type Command = Command;
///     fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut Command) {
///         let distance_m = inputs.estimate.position_m - inputs.measurement.position_m;
///         out.speed_m_s = self.leader_speed_m_s + self.gain_per_s * distance_m;
///     }
/// }
///
/// #[derive(Clone, Serialize, Deserialize)]
/// struct Carts { cart: Parameters }
/// impl SimpleRig for Carts {
///     type Body = Cart;
///     type Estimator = Last;
///     type Law = Parameters;
///     const NAME: &'static str = "carts";
///     const METRICS: &'static [Difference] = &[Difference::following("distance_m", "position_m")];
///     fn body(&self, index: usize) -> Cart {
///         match index {
///             0 => Cart { position_m: 1.0, speed_m_s: self.cart.leader_speed_m_s },
///             _ => Cart { position_m: 0.0, speed_m_s: 0.0 },
///         }
///     }
///     fn estimator(&self) -> Last {
///         Last { position_m: 0.0 }
///     }
///     fn law(&self, _index: usize) -> Parameters {
///         self.cart.clone()
///     }
/// }
///
/// register(vec![RigKind::new::<Carts>()]);
/// let text = r#"
///     name = "two-carts"
///     rig = "carts"
///     tick_hz = 100.0
///     duration_s = 10.0
///     [cart]
///     leader_speed_m_s = 0.5
///     gain_per_s = 2.0
///     [accept]
///     settled_by_s = 5.0
///     distance_m_max = 1e-3
/// "#;
/// let scenario = Scenario::parse(text, "two-carts.toml", &[])?;
/// assert_eq!(scenario.roles(), ["leader", "follower", "observer", "controller"]);
/// # Ok::<(), corotate_runtime::config::ConfigError>(())
/// ```
///
/// A program names its rigs with `Program::new().rig::<Carts>()`, which registers them.
pub trait SimpleRig: Serialize + DeserializeOwned + Clone + Send + Sync + 'static {
    /// The plant: a body with its sensors and actuators.
    type Body: SingleBody + Persist;
    /// The observer of a body.
    type Estimator: Estimator<Measurement = <Self::Body as Body>::Measurement> + Persist;
    /// The control law of a driven body.
    type Law: Law<
            Estimate = <Self::Estimator as Estimator>::Estimate,
            Measurement = <Self::Body as Body>::Measurement,
            Command = <Self::Body as Body>::Command,
        > + Persist;
    /// The value of the scenario key `rig` that selects this rig.
    const NAME: &'static str;
    /// The fields of the type that a scenario gives as lists of tables.
    const LISTS: &'static [&'static str] = &[];
    /// The bodies, if they do not depend on the scenario; the first is always observed. By default a free `leader` and a driven
    /// `follower`.
    const BODIES: &'static [BodyInfo] = &[BodyInfo::free("leader"), BodyInfo::driven("follower")];
    /// The metrics of a run.
    const METRICS: &'static [Difference];
    /// The fields of the truth that follow the scenario's `[reference]`, which has a key for each. The law receives their numbers in
    /// this order.
    const REFERENCE: &'static [&'static str] = &[];

    /// Checks the parameters and records problems by key, as `cart.gain_per_s`. May store what it needs of `_context`.
    fn check(&mut self, _context: Context, _checks: &mut Checks<'_>) {}
    /// Returns the bodies; the first is always observed. By default [`BODIES`](Self::BODIES).
    fn bodies(&self) -> &[BodyInfo] {
        Self::BODIES
    }
    /// Creates the body with this index at its initial state.
    fn body(&self, index: usize) -> Self::Body;
    /// Creates the observer of the first body at its initial guess.
    fn estimator(&self) -> Self::Estimator;
    /// Creates the observer of the body with this index at its initial guess, if the scenario's `observed` lists the body. By default
    /// as that of the first body.
    fn estimator_of(&self, _index: usize) -> Self::Estimator {
        self.estimator()
    }
    /// Creates the law of the driven body with this index.
    fn law(&self, index: usize) -> Self::Law;
    /// Returns the largest permitted magnitude per field name. Guards reject samples beyond it, and samples with NaN or infinity.
    fn bounds(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }
    /// Returns the scenario keys that may change while the loop runs, with the users of each: the body, the estimator and the law
    /// receive new values by their `set_input`.
    fn inputs(&self) -> Vec<InputInfo> {
        Vec::new()
    }
    /// Returns the rig without noise and rounding of its sensors. The analysis of `check` needs it to see how a small error falls, and the
    /// package for Python to linearise the loop.
    #[must_use]
    fn ideal(&self) -> Self {
        self.clone()
    }
    /// Returns the quantities that the controller can watch.
    fn monitors() -> &'static [Monitor<Self>] {
        &[]
    }
    /// Returns the pictures of the motion in a report; by default every number of the truth over time, and the commands.
    fn pictures() -> Vec<Picture> {
        graphs::<Truth<Self>, Measurement<Self>, Command<Self>>()
    }
}

/// A metric: the length of the difference between a field and what it is compared with.
///
/// A metric of the driven bodies is that of the worst one, unless it is [for one body](Self::for_body). The last part of its name is the
/// unit.
#[derive(Debug, Clone, Copy)]
pub struct Difference {
    metric: &'static str,
    field: &'static str,
    compared: Compared,
    /// The name of the only body.
    body: Option<&'static str>,
}

#[derive(Debug, Clone, Copy)]
enum Compared {
    /// The driven bodies with the first body.
    Driven,
    /// The estimate of a body with its truth.
    Estimate,
    /// The driven bodies with the reference.
    Reference,
    /// The driven bodies with zero.
    Zero,
}

impl Difference {
    /// Creates a metric of the driven bodies: the distance of their true field from that of the first body.
    pub const fn following(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, compared: Compared::Driven, body: None }
    }

    /// Creates a metric of the first body's estimate: the distance of its field from that of the truth.
    pub const fn estimating(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, compared: Compared::Estimate, body: None }
    }

    /// Creates a metric of the driven bodies: the distance of their true field from the reference, which must have that field.
    pub const fn from_reference(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, compared: Compared::Reference, body: None }
    }

    /// Creates a metric of the driven bodies: the length of their true field.
    pub const fn from_zero(metric: &'static str, field: &'static str) -> Self {
        Self { metric, field, compared: Compared::Zero, body: None }
    }

    /// Restricts the metric to one body: instead of the worst driven body, or of the first one's estimate. Without a body of this name
    /// the metric has no value, and likewise that of an estimate if the body has no observer.
    ///
    /// ```
    /// # use corotate_runtime::rig::Difference;
    /// const OWN: Difference = Difference::estimating("own_error_m", "position_m").for_body("follower");
    /// ```
    #[must_use]
    pub const fn for_body(self, body: &'static str) -> Self {
        Self { body: Some(body), ..self }
    }

    /// Returns the signal that lacks the metric's field, if there is one. Evaluated at compile time.
    const fn lacking(&self, truth: &[Field], estimate: &[Field], reference: &[&str]) -> Option<&'static str> {
        match self.compared {
            _ if !has(truth, self.field) => Some("truth"),
            Compared::Estimate if !has(estimate, self.field) => Some("estimate"),
            Compared::Reference if !lists(reference, self.field) => Some("reference (REFERENCE)"),
            _ => None,
        }
    }
}

/// Returns true if the list has this name. Usable at compile time.
const fn lists(names: &[&str], name: &str) -> bool {
    let mut index = 0;
    while index < names.len() {
        if same_name(names[index], name) {
            return true;
        }
        index += 1;
    }
    false
}

/// Returns true if there is a numeric field of this name.
const fn has(fields: &[Field], name: &str) -> bool {
    match field_named(fields, name) {
        Some(index) => matches!(fields[index].kind, FieldKind::F64),
        None => false,
    }
}

/// Returns the numbers of a sample's field.
fn numbers<'a, S: Sample>(sample: &'a S, name: &str) -> &'a [f64] {
    let field = S::FIELDS.iter().find(|field| field.name == name);
    let (from, count) = field.map_or((0, 0), |field| (field.offset / size_of::<f64>(), field.count));
    bytemuck::cast_slice(&sample.words()[from..from + count])
}

/// Returns the distance of two vectors; NaN if one is missing.
fn distance(a: Option<&[f64]>, b: Option<&[f64]>) -> f64 {
    match (a, b) {
        (Some(a), Some(b)) => libm::sqrt(a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()),
        _ => f64::NAN,
    }
}

/// A guard that accepts samples whose numbers are finite and within their bounds.
#[derive(Debug, Clone)]
pub struct Bounded {
    /// The word index and the largest magnitude of every number.
    bounds: Vec<(usize, f64)>,
}

impl Bounded {
    fn new<S: Sample>(bounds: &[(&'static str, f64)]) -> Self {
        let words_of = |field: &Field| {
            let bound = bounds.iter().find(|(name, _)| *name == field.name).map_or(f64::MAX, |(_, bound)| *bound);
            let first = field.offset / size_of::<f64>();
            (first..first + field.count).map(move |word| (word, bound))
        };
        let numbers = S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64);
        Self { bounds: numbers.flat_map(words_of).collect() }
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

/// A compile-time check that a rig's metrics and reference name fields of its samples.
struct Declared<R>(R);

impl<R: SimpleRig> Declared<R> {
    const EXIST: () = {
        let (truth, estimate) = (<Truth<R> as Sample>::FIELDS, <Estimate<R> as Sample>::FIELDS);
        let (mut index, mut numbers) = (0, 0);
        while index < R::REFERENCE.len() {
            let name = R::REFERENCE[index];
            let Some(place) = field_named(truth, name) else {
                Sentence::new(&["REFERENCE of the rig ", R::NAME, " names ", name, ", but its truth has no such field"])
                    .panic()
            };
            numbers += truth[place].count;
            if truth[place].count > COMPONENTS_MAX || numbers > REFERENCE_MAX {
                Sentence::new(&["REFERENCE of the rig ", R::NAME, " has too many numbers at ", name]).panic()
            }
            index += 1;
        }
        index = 0;
        while index < R::METRICS.len() {
            let Difference { metric, field, .. } = R::METRICS[index];
            if let Some(signal) = R::METRICS[index].lacking(truth, estimate, R::REFERENCE) {
                Sentence::new(&[
                    "the metric ",
                    metric,
                    " names the field ",
                    field,
                    ", but there is no such number in the ",
                    signal,
                ])
                .panic()
            }
            index += 1;
        }
    };

    /// Returns the numbers of a field of the reference.
    fn numbers<'a>(reference: &'a [f64], name: &str) -> Option<&'a [f64]> {
        let count = |name: &&str| {
            let field = field_named(<Truth<R> as Sample>::FIELDS, name);
            field.map_or(0, |field| <Truth<R> as Sample>::FIELDS[field].count)
        };
        let place = R::REFERENCE.iter().position(|field| *field == name)?;
        let first: usize = R::REFERENCE[..place].iter().map(count).sum();
        reference.get(first..first + count(&R::REFERENCE[place]))
    }
}

/// A message that is put together at compile time.
struct Sentence {
    bytes: [u8; 256],
    length: usize,
}

impl Sentence {
    /// Joins parts; what is too long is cut off.
    const fn new(parts: &[&str]) -> Self {
        let (mut bytes, mut length, mut part) = ([0; 256], 0, 0);
        while part < parts.len() {
            let (text, mut index) = (parts[part].as_bytes(), 0);
            while index < text.len() && length < bytes.len() {
                bytes[length] = text[index];
                (length, index) = (length + 1, index + 1);
            }
            part += 1;
        }
        Self { bytes, length }
    }

    const fn panic(&self) -> ! {
        match core::str::from_utf8(self.bytes.split_at(self.length).0) {
            Ok(text) => panic!("{}", text),
            Err(_) => panic!("a metric of this rig names a field that its samples do not have"),
        }
    }
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

    fn controlled() -> Vec<&'static str> {
        R::METRICS.iter().map(|difference| difference.field).collect()
    }

    fn ideal(&self) -> Self {
        SimpleRig::ideal(self)
    }

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

    fn estimator_of(&self, index: usize) -> Option<Self::Estimator> {
        Some(SimpleRig::estimator_of(self, index))
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

    fn inputs(&self) -> Vec<InputInfo> {
        SimpleRig::inputs(self)
    }

    fn monitors() -> &'static [Monitor<Self>] {
        <R as SimpleRig>::monitors()
    }

    fn metrics(&self) -> Vec<&'static str> {
        R::METRICS.iter().map(|difference| difference.metric).collect()
    }

    fn reference() -> Vec<(&'static str, usize)> {
        let () = Declared::<R>::EXIST;
        let count = |name: &'static str| {
            let field = <Truth<R> as Sample>::FIELDS.iter().find(|field| field.name == name);
            (name, field.map_or(0, |field| field.count))
        };
        R::REFERENCE.iter().copied().map(count).collect()
    }

    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a Truth<Self>>,
        _fleet: impl Fn(usize) -> Option<&'a FleetTruth<Self>>,
        estimate: impl Fn(usize) -> Option<&'a Estimate<Self>>,
        reference: &[f64],
        out: &mut [f64],
    ) {
        let () = Declared::<R>::EXIST;
        let index_of = |name: &str| SimpleRig::bodies(self).iter().position(|body| body.name == name);
        for (value, Difference { field, compared, body: only, .. }) in out.iter_mut().zip(R::METRICS) {
            let first = truth(0).map(|first| numbers(first, field));
            let worst = |error: &dyn Fn(&[f64]) -> f64| {
                let judged = |body: &BodyInfo| only.map_or(body.driven, |only| body.name == only);
                let bodies = SimpleRig::bodies(self).iter().enumerate().filter(|(_, body)| judged(body));
                let errors =
                    bodies.map(|(index, _)| truth(index).map_or(f64::NAN, |truth| error(numbers(truth, field))));
                errors.reduce(|a, b| if a.is_nan() || a > b { a } else { b }).unwrap_or(f64::NAN)
            };
            *value = match compared {
                Compared::Estimate => only.map_or(Some(0), index_of).map_or(f64::NAN, |index| {
                    let own = truth(index).map(|truth| numbers(truth, field));
                    distance(estimate(index).map(|estimate| numbers(estimate, field)), own)
                }),
                Compared::Driven => worst(&|own| distance(Some(own), first)),
                Compared::Reference => worst(&|own| distance(Some(own), Declared::<R>::numbers(reference, field))),
                Compared::Zero => worst(&|own| libm::sqrt(own.iter().map(|number| number * number).sum())),
            };
        }
    }

    fn pictures() -> Vec<Picture> {
        <R as SimpleRig>::pictures()
    }
}
