//! Runs one driven body's loop tick by tick with the roles' own state machines, without links and clocks.
//!
//! It gives the bits of an undisturbed run. Must not repeat the computation of a role.

use crate::config::{Rates, Settings};
use crate::rig::{Command, Estimate, Measurement, Rig, RigLoopBody, Truth, loop_body, observer};
use crate::role::{
    Actuation, Guard, LoopBody, LoopControl, LoopObserver, Observer, Rearm, SUSPECT_SAMPLES, command_index, cycle,
    respond,
};
use crate::sample::{Field, FieldKind, Message, Sample, Stamp};
use crate::state::{Persist, Words, each_number};

/// The loop of a rig's observed body and one driven one, which may be the same, or of all its bodies.
pub(super) struct Chain<R: Rig> {
    rig: R,
    /// The observed body first.
    bodies: Vec<RigLoopBody<R>>,
    /// The index of the driven body that is examined.
    own: usize,
    observer: Observer<R::Estimator>,
    estimate: Estimate<R>,
    rates: Rates,
    reference: Vec<f64>,
    /// The controlled fields of the truth, and of the estimate.
    controlled: [Vec<&'static Field>; 2],
    /// The next tick.
    tick: u64,
}

impl<R: Rig> Chain<R> {
    /// Creates the loop, at its start, of a rig whose last body is the driven one.
    pub fn new(rig: &R, settings: &Settings) -> Self {
        Self::examine(rig, rig.bodies().len() - 1, settings)
    }

    /// Creates the loop of all bodies, at its start, in which the body with index `own` is examined.
    pub fn examine(rig: &R, own: usize, settings: &Settings) -> Self {
        let body = |index: usize| {
            let driven = rig.bodies()[index].driven;
            // No command is ever missing here.
            let actuation = Actuation { timeout_ticks: u64::MAX, rearm: Rearm::Auto, ..settings.actuation(driven) };
            loop_body(rig, index, driven, actuation, settings)
        };
        Self {
            rig: rig.clone(),
            bodies: (0..rig.bodies().len()).map(body).collect(),
            own,
            observer: observer(rig, settings),
            rates: settings.rates,
            estimate: Default::default(),
            reference: settings.reference.clone(),
            controlled: [controlled::<R, Truth<R>>(), controlled::<R, Estimate<R>>()],
            tick: 0,
        }
    }

    /// Runs one tick.
    pub fn advance(&mut self) {
        let stamp = Stamp { tick: self.tick, generation: 1, ..Stamp::default() };
        cycle::<true, _, _, _, _>(&stamp, &mut self.observer, &mut self.estimate, &mut self.bodies);
        self.tick += 1;
    }

    /// Runs one tick in which every number of every measurement is off by `part` of its largest magnitude so far, a little more for
    /// each. `magnitudes` are those of [`measured`](Self::measured).
    pub fn advance_disturbed(&mut self, part: f64, magnitudes: &[f64]) {
        let stamp = Stamp { tick: self.tick, generation: 1, ..Stamp::default() };
        let mut number = 0;
        for body in &mut self.bodies {
            body.turn(&stamp);
            for field in numbers::<Measurement<R>>().filter(|field| !field.name.starts_with("applied_")) {
                for bits in &mut body.measurement.words_mut()[field.offset / 8..][..field.count] {
                    let magnitude = magnitudes.get(number).copied().filter(|size| *size > 0.0).unwrap_or(1.0);
                    let factor = 1.0 + 0.1 * (number % 7) as f64;
                    *bits = (f64::from_bits(*bits) + part * factor * magnitude).to_bits();
                    number += 1;
                }
            }
        }
        respond::<true, _, _, _, _>(&stamp, &mut self.observer, &mut self.estimate, &mut self.bodies);
        self.tick += 1;
    }

    /// Writes the numbers of all measurements at the last tick, without the commands that they tell.
    pub fn measured(&self, out: &mut Vec<f64>) {
        out.clear();
        for body in &self.bodies {
            let fields = numbers::<Measurement<R>>().filter(|field| !field.name.starts_with("applied_"));
            fields.for_each(|field| out.extend(values(&body.measurement, field)));
        }
    }

    /// Returns the driven body with its controller.
    fn driven(&self) -> &RigLoopBody<R> {
        &self.bodies[self.own]
    }

    /// Returns the newest command.
    fn command(&self) -> Option<&Command<R>> {
        let commands = &self.driven().control.as_ref()?.commands;
        Some(&commands[command_index(self.tick - 1, commands.len())])
    }

    /// Computes the rig's metrics at the last tick, in the rig's order.
    pub fn score(&self, out: &mut [f64]) {
        let truth = |index: usize| Some(&self.bodies.get(index)?.truth);
        self.rig.score(truth, |_| None, |index| self.estimate_of(index), &self.reference, out);
    }

    /// Returns the estimate of a body at the last tick, if the body has an observer.
    fn estimate_of(&self, index: usize) -> Option<&Estimate<R>> {
        match index {
            0 => Some(&self.estimate),
            _ => Some(&self.bodies.get(index)?.observed.as_ref()?.estimate),
        }
    }

    /// Returns the first body whose motion has ended, with the reason.
    pub fn loss(&self) -> Option<String> {
        let mut bodies = self.bodies.iter().zip(self.rig.bodies());
        bodies.find_map(|(body, info)| Some(format!("{} {}", info.name, self.rig.loss(&body.truth)?)))
    }

    /// Writes the controlled numbers of the driven body's truth and of the estimate at the last tick.
    pub fn output(&self, out: &mut Vec<f64>) {
        out.clear();
        self.controlled[0].iter().for_each(|field| out.extend(values(&self.driven().truth, field)));
        self.controlled[1].iter().for_each(|field| out.extend(values(&self.estimate, field)));
    }

    /// Writes the controlled numbers of the observed body's truth.
    pub fn observed(&self, out: &mut Vec<f64>) {
        out.clear();
        self.controlled[0].iter().for_each(|field| out.extend(values(&self.bodies[0].truth, field)));
    }

    /// Returns the driven body's coordinate that the loop does not control.
    pub fn free(&self) -> f64 {
        let field = numbers::<Truth<R>>().find(|field| R::FREE == Some(field.name));
        field.and_then(|field| values(&self.driven().truth, field).next()).unwrap_or(0.0)
    }

    /// Returns the status bits of the estimate at the last tick.
    pub fn status(&self) -> u64 {
        let field = Estimate::<R>::FIELDS.iter().find(|field| field.name == "status");
        field.map_or(0, |field| self.estimate.words()[field.offset / 8])
    }

    /// Passes the state of the loop, without that of the motion to follow.
    fn state<W: Words>(&mut self, visitor: &mut W) {
        let LoopBody { plant, control, observed, .. } = &mut self.bodies[self.own];
        plant.persist(visitor);
        let first = (&mut self.observer, &mut self.estimate);
        let own = observed.as_mut().map(|LoopObserver { observer, estimate }| (observer, estimate));
        for (observer, estimate) in [first].into_iter().chain(own) {
            observer.persist(visitor);
            if self.rates.observer_ticks > 1 {
                pass_numbers(estimate, visitor);
            }
        }
        let Some(LoopControl { controller, commands }) = control else { return };
        controller.persist(visitor);
        let delay_ticks = commands.len();
        // The plant holds the command that acts. One that is sent again is the last one.
        let holds_last = self.rates.controller_ticks > 1 && delay_ticks == 1;
        for tick in self.tick + u64::from(!holds_last)..self.tick + delay_ticks as u64 {
            pass_numbers(&mut commands[command_index(tick, delay_ticks)], visitor);
        }
    }

    /// Returns the numbers of the state.
    pub fn numbers(&mut self) -> Vec<f64> {
        let mut numbers = Numbers(Vec::new());
        self.state(&mut numbers);
        numbers.0
    }

    /// Subtracts `away` from every number of the state, then scales its distance from `from` by `factor`.
    pub fn stretch(&mut self, from: &[f64], away: &[f64], factor: f64) {
        self.state(&mut Stretch { from, away, factor });
    }
}

/// The guards of the loop's readers. They only observe: the loop uses a refused sample all the same.
pub(super) struct Guards<R: Rig> {
    measurement: R::MeasurementGuard,
    estimate: R::EstimateGuard,
    own: R::MeasurementGuard,
    command: R::CommandGuard,
    /// The number of samples in a row that each guard has refused.
    refused: [u64; 4],
}

impl<R: Rig> Guards<R> {
    /// Creates the guards of a rig whose last body is the driven one.
    pub fn new(rig: &R) -> Self {
        let last = rig.bodies().len() - 1;
        Self {
            measurement: rig.measurement_guard(0, false),
            estimate: rig.estimate_guard(),
            own: rig.measurement_guard(last, true),
            command: rig.command_guard(last),
            refused: [0; 4],
        }
    }

    /// Judges the samples of the last tick. Returns the name of one that was refused more than [`SUSPECT_SAMPLES`] times in a row:
    /// a guard doubts a correct sample for no longer than that.
    pub fn refuse(&mut self, chain: &Chain<R>) -> Option<&'static str> {
        let accepted = [
            ("the measurement of the observed body", self.measurement.accepts(&chain.bodies[0].measurement)),
            ("the estimate", self.estimate.accepts(&chain.estimate)),
            ("the measurement of the driven body", self.own.accepts(&chain.driven().measurement)),
            ("the command", chain.command().is_none_or(|command| self.command.accepts(command))),
        ];
        let mut counted = self.refused.iter_mut().zip(accepted);
        counted.find_map(|(refused, (name, accepted))| {
            *refused = if accepted { 0 } else { *refused + 1 };
            (*refused > SUSPECT_SAMPLES).then_some(name)
        })
    }
}

/// Returns the fields of a sample that hold numbers.
fn numbers<S: Sample>() -> impl Iterator<Item = &'static Field> {
    S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64)
}

/// Passes the numbers of a sample.
fn pass_numbers<S: Sample, W: Words>(sample: &mut S, visitor: &mut W) {
    for field in numbers::<S>() {
        for bits in &mut sample.words_mut()[field.offset / 8..][..field.count] {
            let mut number = f64::from_bits(*bits);
            visitor.number(&mut number);
            *bits = number.to_bits();
        }
    }
}

fn controlled<R: Rig, S: Sample>() -> Vec<&'static Field> {
    let controlled = R::controlled();
    numbers::<S>().filter(|field| controlled.contains(&field.name)).collect()
}

fn values<'a, S: Sample>(sample: &'a S, field: &Field) -> impl Iterator<Item = f64> + use<'a, S> {
    sample.words()[field.offset / 8..][..field.count].iter().map(|bits| f64::from_bits(*bits))
}

/// Reads the numbers of a state.
struct Numbers(Vec<f64>);

impl Words for Numbers {
    fn word(&mut self, _: &mut u64) {}

    fn number(&mut self, value: &mut f64) {
        self.0.push(*value);
    }

    fn sample(&mut self, words: &mut [u64], is_number: impl Fn(usize) -> bool) {
        each_number(words, is_number, |value| self.number(value));
    }
}

/// Moves the numbers of a state; counters and flags stay.
struct Stretch<'a> {
    from: &'a [f64],
    away: &'a [f64],
    factor: f64,
}

impl Stretch<'_> {
    /// Returns the next pair of numbers of `from` and `away`.
    fn next(&mut self) -> Option<(f64, f64)> {
        let (from, rest) = self.from.split_first()?;
        let (away, rest_away) = self.away.split_first().unwrap_or((&0.0, &[]));
        (self.from, self.away) = (rest, rest_away);
        Some((*from, *away))
    }
}

impl Words for Stretch<'_> {
    fn word(&mut self, _: &mut u64) {}

    fn number(&mut self, value: &mut f64) {
        let Some((from, away)) = self.next() else { return };
        let moved = from + self.factor * (*value - from - away);
        *value = if moved.is_finite() { moved } else { from };
    }

    fn sample(&mut self, words: &mut [u64], is_number: impl Fn(usize) -> bool) {
        each_number(words, is_number, |value| self.number(value));
    }

    /// Resets a weight to that of the reference. Without an error, weights have no effect: a small difference in them is not part
    /// of the linearised loop. It decays more slowly than the error, and scaling it with the error would let it outgrow that.
    fn weight(&mut self, value: &mut f64) {
        *value = self.next().map_or(*value, |(from, _)| from);
    }
}
