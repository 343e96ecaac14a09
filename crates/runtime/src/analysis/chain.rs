//! One driven body's loop in one place: the roles' own state machines, tick by tick, without links and clocks.
//!
//! It gives the bits of an undisturbed run. Must not compute anything that a role computes.

use crate::rig::{Command, Estimate, Measurement, Rig, Truth};
use crate::role::{Actuation, Controller, Guard, Observer, Plant, Rearm, SUSPECT_SAMPLES};
use crate::sample::{Field, FieldKind, Message, Sample, Stamp};
use crate::state::{Persist, Words};

/// The loop of a rig's observed body and one driven one, which may be the same.
pub(super) struct Chain<R: Rig> {
    rig: R,
    observed: Plant<R::Body>,
    /// None if the observed body is the driven one.
    driven: Option<Plant<R::Body>>,
    observer: Observer<R::Estimator>,
    controller: Controller<R::Law>,
    measurement: Measurement<R>,
    own: Measurement<R>,
    /// Those on their way and the one that acts, by their tick modulo the delay.
    commands: Vec<Command<R>>,
    truths: [Truth<R>; 2],
    estimate: Estimate<R>,
    /// What the loop is to control of the truth, and of the estimate.
    controlled: [Vec<&'static Field>; 2],
    tick: u64,
}

impl<R: Rig> Chain<R> {
    /// The loop of a rig whose last body is the driven one, at its start.
    pub fn new(rig: &R, tick_s: f64, delay_ticks: u64) -> Self {
        let last = rig.bodies().len() - 1;
        let plant = |index: usize| {
            let driven = rig.bodies()[index].driven;
            // No command is ever missing here.
            let actuation = Actuation { driven, delay_ticks, timeout_ticks: u64::MAX, rearm: Rearm::Auto };
            Plant::new(rig.body(index), actuation, tick_s)
        };
        Self {
            rig: rig.clone(),
            observed: plant(0),
            driven: (last > 0).then(|| plant(last)),
            observer: Observer::new(rig.estimator(), tick_s),
            controller: Controller::new(rig.law(last)),
            measurement: Default::default(),
            own: Default::default(),
            commands: vec![Default::default(); delay_ticks as usize],
            truths: Default::default(),
            estimate: Default::default(),
            controlled: [controlled::<R, Truth<R>>(), controlled::<R, Estimate<R>>()],
            tick: 0,
        }
    }

    fn place(&self, tick: u64) -> usize {
        (tick % self.commands.len() as u64) as usize
    }

    /// The command made last.
    fn command(&self) -> &Command<R> {
        &self.commands[self.place(self.tick - 1)]
    }

    /// One tick: measure, estimate, command, move on, and hand over the command that is to act then. With a delay of one tick
    /// nothing is in flight between two ticks.
    pub fn advance(&mut self) {
        let (made, acts) = (self.place(self.tick), self.place(self.tick + 1));
        let stamp = Stamp { tick: self.tick, generation: 1, ..Stamp::default() };
        self.observed.measure(&stamp, &mut self.measurement);
        self.observer.step(&self.measurement, &mut self.estimate);
        self.observed.truth(&stamp, &mut self.truths[0]);
        self.tick += 1;
        match &mut self.driven {
            Some(driven) => {
                driven.measure(&stamp, &mut self.own);
                driven.truth(&stamp, &mut self.truths[1]);
                self.controller.step(&self.estimate, &self.own, &mut self.commands[made]);
                driven.advance(1);
                driven.command(self.tick, Some(&self.commands[acts]));
                self.observed.advance(1);
            }
            None => {
                self.controller.step(&self.estimate, &self.measurement, &mut self.commands[made]);
                self.observed.advance(1);
                self.observed.command(self.tick, Some(&self.commands[acts]));
            }
        }
    }

    /// The rig's metrics at the last tick, in its order.
    pub fn score(&self, out: &mut [f64]) {
        self.rig.score(|index| self.truths.get(index), |_| None, Some(&self.estimate), out);
    }

    /// Which body's motion has ended, and how, if one's has.
    pub fn loss(&self) -> Option<String> {
        let losses = self.truths.iter().zip(self.rig.bodies());
        losses.filter_map(|(truth, body)| Some(format!("{} {}", body.name, self.rig.loss(truth)?))).next()
    }

    /// Every number of the driven body's motion and of the estimate at the last tick that the loop is to control.
    pub fn output(&self, out: &mut Vec<f64>) {
        out.clear();
        self.controlled[0].iter().for_each(|field| out.extend(values(self.truth(), field)));
        self.controlled[1].iter().for_each(|field| out.extend(values(&self.estimate, field)));
    }

    /// Every number of the observed body's motion that the loop is to control.
    pub fn observed(&self, out: &mut Vec<f64>) {
        out.clear();
        self.controlled[0].iter().for_each(|field| out.extend(values(&self.truths[0], field)));
    }

    /// The driven body's coordinate that the loop does not control.
    pub fn free(&self) -> f64 {
        let field = numbers::<Truth<R>>().find(|field| R::FREE == Some(field.name));
        field.and_then(|field| values(self.truth(), field).next()).unwrap_or(0.0)
    }

    /// The driven body's.
    fn truth(&self) -> &Truth<R> {
        &self.truths[usize::from(self.driven.is_some())]
    }

    /// The bits of the estimate's `status` at the last tick.
    pub fn status(&self) -> u64 {
        let field = Estimate::<R>::FIELDS.iter().find(|field| field.name == "status");
        field.map_or(0, |field| self.estimate.words()[field.offset / 8])
    }

    /// Passes what the loop remembers, but for the motion that it is to follow.
    fn state<W: Words>(&mut self, words: &mut W) {
        match &mut self.driven {
            Some(driven) => driven.persist(words),
            None => self.observed.persist(words),
        }
        self.observer.persist(words);
        self.controller.persist(words);
        // The plant has the one that acts.
        let (tick, count) = (self.tick, self.commands.len() as u64);
        for command in (1..count).map(|after| ((tick + after) % count) as usize) {
            let sent = self.commands[command].words_mut();
            for field in numbers::<Command<R>>() {
                for bits in &mut sent[field.offset / 8..][..field.count] {
                    let mut number = f64::from_bits(*bits);
                    words.number(&mut number);
                    *bits = number.to_bits();
                }
            }
        }
    }

    /// The numbers of the state.
    pub fn numbers(&mut self) -> Vec<f64> {
        let mut numbers = Numbers(Vec::new());
        self.state(&mut numbers);
        numbers.0
    }

    /// Takes from every number of the state what `away` has, and then makes its distance from `from` so many times as large.
    pub fn stretch(&mut self, from: &[f64], away: &[f64], factor: f64) {
        self.state(&mut Stretch { from, away, factor });
    }
}

/// The guards of the loop's readers. They look on: what they refuse takes part in the loop all the same.
pub(super) struct Guards<R: Rig> {
    measurement: R::MeasurementGuard,
    estimate: R::EstimateGuard,
    own: R::MeasurementGuard,
    command: R::CommandGuard,
    /// How many samples in a row each has refused.
    refused: [u64; 4],
}

impl<R: Rig> Guards<R> {
    /// Those of a rig whose last body is the driven one.
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

    /// Judges the samples of the last tick. Tells which of them has been refused for longer than a guard doubts what is
    /// right, if one has.
    pub fn refuse(&mut self, chain: &Chain<R>) -> Option<&'static str> {
        let own = if chain.driven.is_some() { &chain.own } else { &chain.measurement };
        let accepted = [
            ("the measurement of the observed body", self.measurement.accepts(&chain.measurement)),
            ("the estimate", self.estimate.accepts(&chain.estimate)),
            ("the measurement of the driven body", self.own.accepts(own)),
            ("the command", self.command.accepts(chain.command())),
        ];
        let mut counted = self.refused.iter_mut().zip(accepted);
        counted.find_map(|(refused, (name, accepted))| {
            *refused = if accepted { 0 } else { *refused + 1 };
            (*refused > SUSPECT_SAMPLES).then_some(name)
        })
    }
}

/// The fields of a sample that are numbers.
fn numbers<S: Sample>() -> impl Iterator<Item = &'static Field> {
    S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64)
}

fn controlled<R: Rig, S: Sample>() -> Vec<&'static Field> {
    numbers::<S>().filter(|field| R::CONTROLLED.contains(&field.name)).collect()
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
}

/// Moves the numbers of a state; counters and flags stay.
struct Stretch<'a> {
    from: &'a [f64],
    away: &'a [f64],
    factor: f64,
}

impl Stretch<'_> {
    /// The next number of where the distance is measured from, and of what is taken away.
    fn next(&mut self) -> Option<(f64, f64)> {
        let (from, rest) = self.from.split_first()?;
        let (away, further) = self.away.split_first().unwrap_or((&0.0, &[]));
        (self.from, self.away) = (rest, further);
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

    /// Where nothing errs, weights change nothing: a small difference in them is no part of the linearised loop. It falls more
    /// slowly than the error, and would outgrow it by being stretched with it.
    fn weight(&mut self, value: &mut f64) {
        *value = self.next().map_or(*value, |(from, _)| from);
    }
}
