//! The role of a device: a body, an observer, a controller, or observer and controller together.
//!
//! Each is a role of this library whose samples are read from one message and written to another. This module must
//! not depend on the transport of messages.

use super::message::{Hello, MAX_CONTENT, MAX_SAMPLES, Samples};
use crate::role::{Actuation, CommandEvent, Controller, Estimator, Law, Observer, Plant, Rearm, SingleBody};
use crate::sample::{Sample, Stamp, content_length};

/// The largest number of missed ticks that a body catches up; after a longer absence its clock jumps.
const CATCH_UP_TICKS: u64 = 100_000;

/// A sample's layout as both ends must agree on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// The value of [`Sample::LAYOUT`].
    pub name: &'static str,
    /// The number of bytes after the stamp.
    pub length: usize,
}

impl Layout {
    /// Returns the layout of a sample.
    pub const fn for_sample<S: Sample>() -> Self {
        Self { name: S::LAYOUT, length: content_length::<S>() }
    }
}

/// The role of a device in one run: a state machine, executed tick by tick.
pub trait DeviceRole {
    /// Returns the layouts of the samples that the role reads, in order.
    fn reads() -> impl Iterator<Item = Layout>;
    /// Returns the layouts of the samples that the role writes, in order.
    fn writes() -> impl Iterator<Item = Layout>;
    /// Executes a tick. Each tick is executed at most once, in order.
    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent;
    /// Completes the executed tick with work that the answer does not wait for.
    fn finish_tick(&mut self) {}
    /// Handles `ticks` missed ticks from `from` on.
    fn miss(&mut self, _from: u64, _ticks: u64) {}
    /// Returns the number of further missed ticks after which the role applies its safe command; 0 if it acts or does
    /// not exist.
    fn ticks_until_safe(&self) -> u64 {
        0
    }
    /// Applies the safe command now.
    fn expire(&mut self) {}
}

/// The samples of a request, read in order.
pub struct Inputs<'a> {
    present: u32,
    bytes: &'a [u8],
}

impl<'a> Inputs<'a> {
    /// Returns the samples of a message, if they have the agreed layouts.
    pub(super) fn new(samples: Samples<'a>, layouts: impl Iterator<Item = Layout>) -> Option<Self> {
        let fits = length(layouts, samples.present) == Some(samples.bytes.len());
        fits.then_some(Self { present: samples.present, bytes: samples.bytes })
    }

    /// Returns the next sample with this tick in its stamp, if the sample is present.
    pub fn take<S: Sample>(&mut self, tick: u64) -> Option<S> {
        let there = self.present & 1 == 1;
        self.present >>= 1;
        let (content, rest) = self.bytes.split_at_checked(content_length::<S>()).filter(|_| there)?;
        self.bytes = rest;
        let mut sample = S::default();
        sample.set_content(content);
        sample.stamp_mut().tick = tick;
        Some(sample)
    }
}

/// The samples of an answer, written in order.
pub struct Outputs {
    present: u32,
    count: usize,
    bytes: [u8; MAX_CONTENT],
    length: usize,
}

impl Default for Outputs {
    fn default() -> Self {
        Self { present: 0, count: 0, bytes: [0; MAX_CONTENT], length: 0 }
    }
}

impl Outputs {
    /// Writes the next sample; `None` if it is missing at this tick.
    pub fn put<S: Sample>(&mut self, sample: Option<&S>) {
        let index = self.count;
        self.count += 1;
        let Some(content) = sample.map(|sample| sample.content()).filter(|_| index < MAX_SAMPLES) else { return };
        if let Some(place) = self.bytes.get_mut(self.length..self.length + content.len()) {
            place.copy_from_slice(content);
            self.length += content.len();
            self.present |= 1 << index;
        }
    }

    pub(super) fn clear(&mut self) {
        (self.present, self.count, self.length) = (0, 0, 0);
    }

    pub(super) fn samples(&self) -> Samples<'_> {
        Samples { present: self.present, bytes: self.bytes.get(..self.length).unwrap_or_default() }
    }
}

/// Returns the size of the present samples, bytes; `None` if there are more samples than layouts.
pub(super) fn length(layouts: impl Iterator<Item = Layout>, present: u32) -> Option<usize> {
    let mut left = present;
    let mut bytes = 0;
    for layout in layouts {
        bytes += if left & 1 == 1 { layout.length } else { 0 };
        left >>= 1;
    }
    (left == 0).then_some(bytes)
}

/// The role of a body with its sensors and actuators, which protect themselves: a [`Plant`].
pub struct DevicePlant<B: SingleBody> {
    plant: Plant<B>,
    with_truth: bool,
}

impl<B: SingleBody> DevicePlant<B> {
    /// Creates a body at its initial state, with the parameters of the greeting.
    pub fn new(body: B, hello: &Hello<'_>) -> Self {
        let rearm = if hello.manual_rearm { Rearm::Manual } else { Rearm::Auto };
        let actuation = Actuation { driven: true, delay_ticks: 1, timeout_ticks: hello.timeout_ticks, rearm };
        Self { plant: Plant::new(body, actuation, hello.period_ns as f64 / 1e9), with_truth: true }
    }

    /// Omits the truth from the answers, for a real body, which knows only its measurements.
    #[must_use]
    pub fn without_truth(mut self) -> Self {
        self.with_truth = false;
        self
    }
}

impl<B: SingleBody> DeviceRole for DevicePlant<B> {
    fn reads() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<B::Command>()].into_iter()
    }

    fn writes() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<B::Measurement>(), Layout::for_sample::<B::Truth>()].into_iter()
    }

    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent {
        // The command was computed from the measurement of the previous tick.
        let command = inputs.take::<B::Command>(tick.saturating_sub(1));
        let event = self.plant.command(tick, command.as_ref());
        let stamp = Stamp { tick, ..Stamp::default() };
        let (mut measurement, mut truth) = (B::Measurement::default(), B::Truth::default());
        self.plant.measure(&stamp, &mut measurement);
        self.plant.truth(&stamp, &mut truth);
        outputs.put(Some(&measurement));
        outputs.put(Some(&truth).filter(|_| self.with_truth));
        event
    }

    /// Moves the body.
    fn finish_tick(&mut self) {
        self.plant.advance(1);
    }

    /// Advances the body over missed ticks: the actuators hold the last input, then apply the safe command.
    fn miss(&mut self, from: u64, ticks: u64) {
        for tick in from..from.saturating_add(ticks.min(CATCH_UP_TICKS)) {
            self.plant.command(tick, None);
            self.plant.advance(1);
        }
    }

    fn ticks_until_safe(&self) -> u64 {
        self.plant.ticks_until_safe()
    }

    fn expire(&mut self) {
        self.plant.expire();
    }
}

/// The role of an observer of one body.
pub struct DeviceObserver<E: Estimator> {
    observer: Observer<E>,
}

impl<E: Estimator> DeviceObserver<E> {
    /// Creates an observer at its initial guess, with the period of the greeting.
    pub fn new(estimator: E, hello: &Hello<'_>) -> Self {
        Self { observer: Observer::new(estimator, hello.period_ns as f64 / 1e9) }
    }

    /// Computes the estimate of a tick. A missing measurement was not accepted by the host's guard; without a
    /// measurement the host does not ask.
    fn estimate(&mut self, tick: u64, inputs: &mut Inputs<'_>) -> E::Estimate {
        let mut estimate = E::Estimate::default();
        match inputs.take::<E::Measurement>(tick) {
            Some(measurement) => self.observer.step(&measurement, &mut estimate),
            None => self.observer.reject(&Stamp { tick, ..Stamp::default() }, &mut estimate),
        }
        estimate
    }
}

impl<E: Estimator> DeviceRole for DeviceObserver<E> {
    fn reads() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<E::Measurement>()].into_iter()
    }

    fn writes() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<E::Estimate>()].into_iter()
    }

    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent {
        outputs.put(Some(&self.estimate(tick, inputs)));
        CommandEvent::NotDue
    }
}

/// The role of a controller of N driven bodies.
pub struct DeviceController<L: Law, const N: usize> {
    controllers: [Controller<L>; N],
    drives_first: bool,
}

impl<L: Law<Measurement: Sample, Command: Sample>, const N: usize> DeviceController<L, N> {
    /// Creates a controller with the law of each body and the period of the greeting. It has no reference.
    pub fn new(laws: [L; N], hello: &Hello<'_>) -> Self {
        let controllers = laws.map(|law| Controller::new(law, hello.period_ns as f64 / 1e9));
        Self { controllers, drives_first: false }
    }

    /// States that the first law drives the first body of the scenario: the estimate is that of its own body.
    #[must_use]
    pub fn driving_first(self) -> Self {
        Self { drives_first: true, ..self }
    }

    /// Computes one command for each body whose measurement is present.
    fn command(&mut self, tick: u64, estimate: Option<&L::Estimate>, inputs: &mut Inputs<'_>, outputs: &mut Outputs) {
        for (index, controller) in self.controllers.iter_mut().enumerate() {
            let own_estimate = estimate.filter(|_| self.drives_first && index == 0);
            let measurement = inputs.take::<L::Measurement>(tick);
            let command = estimate.zip(measurement).map(|(estimate, measurement)| {
                let mut command = L::Command::default();
                controller.step(estimate, own_estimate, &measurement, &mut command);
                command
            });
            outputs.put(command.as_ref());
        }
    }
}

impl<L: Law<Measurement: Sample, Command: Sample>, const N: usize> DeviceRole for DeviceController<L, N> {
    fn reads() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<L::Estimate>()].into_iter().chain([Layout::for_sample::<L::Measurement>(); N])
    }

    fn writes() -> impl Iterator<Item = Layout> {
        [Layout::for_sample::<L::Command>(); N].into_iter()
    }

    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent {
        let estimate = inputs.take::<L::Estimate>(tick);
        self.command(tick, estimate.as_ref(), inputs, outputs);
        CommandEvent::NotDue
    }
}

/// The role of a flight computer: observer and controller in one device. It reads measurements and writes the
/// estimate and the commands.
pub struct DeviceFlightComputer<E: Estimator, L: Law, const N: usize> {
    observer: DeviceObserver<E>,
    controller: DeviceController<L, N>,
}

impl<E, L, const N: usize> DeviceFlightComputer<E, L, N>
where
    E: Estimator,
    L: Law<Estimate = E::Estimate, Measurement: Sample, Command: Sample>,
{
    /// Creates both roles at their initial states, with the period of the greeting.
    pub fn new(estimator: E, laws: [L; N], hello: &Hello<'_>) -> Self {
        Self { observer: DeviceObserver::new(estimator, hello), controller: DeviceController::new(laws, hello) }
    }

    /// As [`DeviceController::driving_first`].
    #[must_use]
    pub fn driving_first(self) -> Self {
        Self { controller: self.controller.driving_first(), ..self }
    }
}

impl<E, L, const N: usize> DeviceRole for DeviceFlightComputer<E, L, N>
where
    E: Estimator,
    L: Law<Estimate = E::Estimate, Measurement: Sample, Command: Sample>,
{
    fn reads() -> impl Iterator<Item = Layout> {
        DeviceObserver::<E>::reads().chain(DeviceController::<L, N>::reads().skip(1))
    }

    fn writes() -> impl Iterator<Item = Layout> {
        DeviceObserver::<E>::writes().chain(DeviceController::<L, N>::writes())
    }

    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent {
        let estimate = self.observer.estimate(tick, inputs);
        outputs.put(Some(&estimate));
        self.controller.command(tick, Some(&estimate), inputs, outputs);
        CommandEvent::NotDue
    }
}
