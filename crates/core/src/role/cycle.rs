//! One tick of a whole loop in one thread: the roles called one after the other, on samples that stay in place. A role that is not due
//! repeats its last sample.
//!
//! It gives the bits of an undisturbed run. It must not judge a sample, nor repeat the computation of a role.

use super::{CommandEvent, Controller, Estimator, Law, Observer, Plant, SingleBody};
use crate::sample::{Message, Stamp};

/// A body with its newest samples, and its controller if it is driven.
pub struct LoopBody<B: SingleBody, L: Law, C> {
    /// The body with its actuators.
    pub plant: Plant<B>,
    /// Its newest measurement.
    pub measurement: B::Measurement,
    /// Its newest state.
    pub truth: B::Truth,
    /// The controller with its commands; `None` if the body is free.
    pub control: Option<LoopControl<L, C>>,
}

impl<B: SingleBody, L: Law<Command = B::Command>, C: AsMut<[B::Command]>> LoopBody<B, L, C> {
    /// Creates a body before its first tick.
    pub fn new(plant: Plant<B>, control: Option<LoopControl<L, C>>) -> Self {
        Self { plant, measurement: Default::default(), truth: Default::default(), control }
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

/// Returns the index of a tick's command among `delay_ticks` commands. It is also that of the command that acts from this tick on,
/// until the tick's own command replaces it.
#[inline]
pub fn command_index(tick: u64, delay_ticks: usize) -> usize {
    // Usually needs no division.
    if delay_ticks == 1 { 0 } else { (tick % delay_ticks as u64) as usize }
}

/// Runs one tick: every body measures and moves, the observer reads the first one, each controller commands its body, and the
/// commands that are due act from the next tick on. Returns false if a command that is due does not act.
#[inline]
pub fn cycle<B, E, L, C>(
    stamp: &Stamp,
    observer: &mut Observer<E>,
    estimate: &mut E::Estimate,
    bodies: &mut [LoopBody<B, L, C>],
) -> bool
where
    B: SingleBody,
    E: Estimator<Measurement = B::Measurement>,
    L: Law<Estimate = E::Estimate, Measurement = B::Measurement, Command = B::Command>,
    C: AsMut<[B::Command]>,
{
    bodies.iter_mut().for_each(|body| body.turn(stamp));
    respond(stamp, observer, estimate, bodies)
}

/// Runs the part of a tick after the bodies' turns: observer and controllers. Returns false if a command that is due does not act.
#[inline]
pub fn respond<B, E, L, C>(
    stamp: &Stamp,
    observer: &mut Observer<E>,
    estimate: &mut E::Estimate,
    bodies: &mut [LoopBody<B, L, C>],
) -> bool
where
    B: SingleBody,
    E: Estimator<Measurement = B::Measurement>,
    L: Law<Estimate = E::Estimate, Measurement = B::Measurement, Command = B::Command>,
    C: AsMut<[B::Command]>,
{
    let Some(observed) = bodies.first() else { return true };
    if observer.is_due(stamp.tick) {
        observer.step(&observed.measurement, estimate);
    } else {
        estimate.stamp_mut().answer(observed.measurement.stamp());
    }
    estimate.stamp_mut().generation = stamp.generation;
    let mut all_act = true;
    for LoopBody { plant, measurement, control, .. } in bodies {
        let Some(LoopControl { controller, commands }) = control else { continue };
        let (commands, next) = (commands.as_mut(), stamp.tick + 1);
        let delay_ticks = commands.len();
        if !controller.is_due(stamp.tick) {
            repeat_last(commands, stamp.tick);
        }
        let command = &mut commands[command_index(stamp.tick, delay_ticks)];
        if controller.is_due(stamp.tick) {
            controller.step(estimate, measurement, command);
        } else {
            command.stamp_mut().answer(estimate.stamp());
        }
        command.stamp_mut().generation = stamp.generation;
        let expected = if next < delay_ticks as u64 { CommandEvent::NotDue } else { CommandEvent::Applied };
        all_act &= plant.command(next, Some(&commands[command_index(next, delay_ticks)])) == expected;
    }
    all_act
}

/// Copies the command of the tick before this one.
#[cold]
fn repeat_last<C: Copy>(commands: &mut [C], tick: u64) {
    let delay_ticks = commands.len();
    commands[command_index(tick, delay_ticks)] = commands[command_index(tick.saturating_sub(1), delay_ticks)];
}
