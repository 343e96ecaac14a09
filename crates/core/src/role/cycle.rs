//! One tick of a whole loop in one thread: the roles called one after the other, on samples that stay in place. A role that is not due
//! repeats its last sample.
//!
//! It gives the bits of an undisturbed run. It must not judge a sample, nor repeat the computation of a role.

use super::controller::{Controller, Law};
use super::observer::{Estimator, Observer};
use super::plant::{CommandEvent, Plant, SingleBody};
use crate::sample::{Message, Stamp};

/// A body with its newest samples, its controller if it is driven, and its observer unless it is the first body.
pub struct LoopBody<B: SingleBody, E: Estimator, L: Law, C> {
    /// The body with its actuators.
    pub plant: Plant<B>,
    /// Its newest measurement.
    pub measurement: B::Measurement,
    /// Its newest state.
    pub truth: B::Truth,
    /// The controller with its commands; `None` if the body is free.
    pub control: Option<LoopControl<L, C>>,
    /// The observer of this body; `None` for the first body, whose observer is that of the loop, and for one without observer.
    pub observed: Option<LoopObserver<E>>,
}

impl<B: SingleBody, E: Estimator, L: Law<Command = B::Command>, C: AsMut<[B::Command]>> LoopBody<B, E, L, C> {
    /// Creates a body before its first tick.
    pub fn new(plant: Plant<B>, control: Option<LoopControl<L, C>>) -> Self {
        Self { plant, measurement: Default::default(), truth: Default::default(), control, observed: None }
    }

    /// Adds an observer of this body, which is not the first.
    #[must_use]
    pub fn observed(self, observer: Option<Observer<E>>) -> Self {
        Self { observed: observer.map(|observer| LoopObserver { observer, estimate: Default::default() }), ..self }
    }

    /// Measures, tells the state and moves for a tick.
    #[inline]
    pub fn turn(&mut self, stamp: &Stamp) {
        self.plant.measure(stamp, &mut self.measurement);
        self.plant.truth(stamp, &mut self.truth);
        self.plant.advance(1);
    }
}

/// The controller of a body with the commands that do not act yet.
pub struct LoopControl<L, C> {
    /// The control law.
    pub controller: Controller<L>,
    /// One command for each tick of the actuation delay, indexed by [`command_index`].
    pub commands: C,
}

/// An observer with its newest estimate.
pub struct LoopObserver<E: Estimator> {
    /// The observer.
    pub observer: Observer<E>,
    /// Its newest estimate.
    pub estimate: E::Estimate,
}

/// Returns the index of a tick's command among `delay_ticks` commands. It is also that of the command that acts from this tick on,
/// until the tick's own command replaces it.
#[inline]
pub fn command_index(tick: u64, delay_ticks: usize) -> usize {
    // Usually needs no division.
    if delay_ticks == 1 { 0 } else { (tick % delay_ticks as u64) as usize }
}

/// Runs one tick: every body measures and moves, the observer reads the first one, each controller commands its body, and the
/// commands that are due act from the next tick on. Returns false if a command that is due does not act.
///
/// `FURTHER` is true if bodies other than the first may have observers: a loop without them pays nothing for the question.
#[inline]
pub fn cycle<const FURTHER: bool, B, E, L, C>(
    stamp: &Stamp,
    observer: &mut Observer<E>,
    estimate: &mut E::Estimate,
    bodies: &mut [LoopBody<B, E, L, C>],
) -> bool
where
    B: SingleBody,
    E: Estimator<Measurement = B::Measurement>,
    L: Law<Estimate = E::Estimate, Measurement = B::Measurement, Command = B::Command>,
    C: AsMut<[B::Command]>,
{
    bodies.iter_mut().for_each(|body| body.turn(stamp));
    respond::<FURTHER, _, _, _, _>(stamp, observer, estimate, bodies)
}

/// Runs the part of a tick after the bodies' turns: observers and controllers. Returns false if a command that is due does not act.
#[inline]
pub fn respond<const FURTHER: bool, B, E, L, C>(
    stamp: &Stamp,
    observer: &mut Observer<E>,
    estimate: &mut E::Estimate,
    bodies: &mut [LoopBody<B, E, L, C>],
) -> bool
where
    B: SingleBody,
    E: Estimator<Measurement = B::Measurement>,
    L: Law<Estimate = E::Estimate, Measurement = B::Measurement, Command = B::Command>,
    C: AsMut<[B::Command]>,
{
    let Some(observed) = bodies.first() else { return true };
    observe(stamp, observer, &observed.measurement, estimate);
    let mut all_act = true;
    for (index, LoopBody { plant, measurement, control, observed, .. }) in bodies.iter_mut().enumerate() {
        let mut own_estimate = (index == 0).then_some(&*estimate);
        if FURTHER && let Some(LoopObserver { observer, estimate }) = observed {
            observe(stamp, observer, measurement, estimate);
            own_estimate = Some(estimate);
        }
        let Some(LoopControl { controller, commands }) = control else { continue };
        let (commands, next) = (commands.as_mut(), stamp.tick + 1);
        let delay_ticks = commands.len();
        if !controller.is_due(stamp.tick) {
            repeat_last(commands, stamp.tick);
        }
        let command = &mut commands[command_index(stamp.tick, delay_ticks)];
        if controller.is_due(stamp.tick) {
            controller.step(estimate, own_estimate, measurement, command);
        } else {
            command.stamp_mut().answer(estimate.stamp());
        }
        command.stamp_mut().generation = stamp.generation;
        let expected = if next < delay_ticks as u64 { CommandEvent::NotDue } else { CommandEvent::Applied };
        all_act &= plant.command(next, Some(&commands[command_index(next, delay_ticks)])) == expected;
    }
    all_act
}

/// Computes an estimate from the measurement of the same tick, or sends the last one again.
#[inline(always)]
fn observe<E: Estimator>(
    stamp: &Stamp,
    observer: &mut Observer<E>,
    measurement: &E::Measurement,
    out: &mut E::Estimate,
) {
    if observer.is_due(stamp.tick) {
        observer.step(measurement, out);
    } else {
        out.stamp_mut().answer(measurement.stamp());
    }
    out.stamp_mut().generation = stamp.generation;
}

/// Copies the command of the tick before this one.
#[cold]
fn repeat_last<C: Copy>(commands: &mut [C], tick: u64) {
    let delay_ticks = commands.len();
    commands[command_index(tick, delay_ticks)] = commands[command_index(tick.saturating_sub(1), delay_ticks)];
}
