//! What a device is in a run: a body, an observer, a controller, or observer and controller together.
//!
//! Each is the role of this library with its samples taken from a message and put into one. Must not know how messages come.

use super::message::{Hello, MAX_CONTENT, MAX_SAMPLES, Samples};
use crate::role::{Actuation, CommandEvent, Controller, Estimator, Law, Observer, Plant, Rearm, SingleBody};
use crate::sample::{Sample, Stamp, content_length};

/// A body lives through at most so many ticks that it missed; after a longer absence its clock jumps.
const CATCH_UP_TICKS: u64 = 100_000;

/// A sample as both ends must agree on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// [`Sample::LAYOUT`].
    pub name: &'static str,
    /// Bytes after its stamp.
    pub length: usize,
}

impl Layout {
    /// That of a sample.
    pub const fn for_sample<S: Sample>() -> Self {
        Self { name: S::LAYOUT, length: content_length::<S>() }
    }
}

/// What a device is in one run: a state machine, tick by tick.
pub trait DeviceRole {
    /// The samples that it reads, in order.
    fn reads() -> impl Iterator<Item = Layout>;
    /// The samples that it writes, in order.
    fn writes() -> impl Iterator<Item = Layout>;
    /// Executes a tick: each once, in order, but for those that are missed.
    fn execute(&mut self, tick: u64, inputs: &mut Inputs<'_>, outputs: &mut Outputs) -> CommandEvent;
    /// Does what the tick just executed left to be done. The answer does not wait for it.
    fn settle(&mut self) {}
    /// So many ticks from this one on never came.
    fn miss(&mut self, _from: u64, _ticks: u64) {}
    /// After how many more ticks without any word it goes to its safe command by itself; 0 if that acts, or there is none.
    fn ticks_until_safe(&self) -> u64 {
        0
    }
    /// Goes to the safe command now.
    fn expire(&mut self) {}
}

/// The samples of a request, taken one after another.
pub struct Inputs<'a> {
    present: u32,
    bytes: &'a [u8],
}

impl<'a> Inputs<'a> {
    /// Those of a message, if it has what was agreed upon.
    pub(super) fn new(samples: Samples<'a>, layouts: impl Iterator<Item = Layout>) -> Option<Self> {
        let fits = length(layouts, samples.present) == Some(samples.bytes.len());
        fits.then_some(Self { present: samples.present, bytes: samples.bytes })
    }

    /// The next sample with its tick in its stamp, if it is there.
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

/// The samples of an answer, put one after another.
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
    /// The next sample; none if there is none at this tick.
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

/// How many bytes the samples take that are present; none if there are others than these.
pub(super) fn length(layouts: impl Iterator<Item = Layout>, present: u32) -> Option<usize> {
    let mut left = present;
    let mut bytes = 0;
    for layout in layouts {
        bytes += if left & 1 == 1 { layout.length } else { 0 };
        left >>= 1;
    }
    (left == 0).then_some(bytes)
}

/// A body with its sensors and actuators, which protect themselves: a [`Plant`].
pub struct DevicePlant<B: SingleBody> {
    plant: Plant<B>,
    tells_truth: bool,
}

impl<B: SingleBody> DevicePlant<B> {
    /// A body at its initial state, in the run of this greeting.
    pub fn new(body: B, hello: &Hello<'_>) -> Self {
        let rearm = if hello.manual_rearm { Rearm::Manual } else { Rearm::Auto };
        let actuation = Actuation { driven: true, delay_ticks: 1, timeout_ticks: hello.timeout_ticks, rearm };
        Self { plant: Plant::new(body, actuation, hello.period_ns as f64 / 1e9), tells_truth: true }
    }

    /// One that tells its measurements only: a real one, which knows no more than its sensors do.
    #[must_use]
    pub fn without_truth(mut self) -> Self {
        self.tells_truth = false;
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
        // It was computed from the measurement of the tick before.
        let command = inputs.take::<B::Command>(tick.saturating_sub(1));
        let event = self.plant.command(tick, command.as_ref());
        let stamp = Stamp { tick, ..Stamp::default() };
        let (mut measurement, mut truth) = (B::Measurement::default(), B::Truth::default());
        self.plant.measure(&stamp, &mut measurement);
        self.plant.truth(&stamp, &mut truth);
        outputs.put(Some(&measurement));
        outputs.put(Some(&truth).filter(|_| self.tells_truth));
        event
    }

    /// Moves the body.
    fn settle(&mut self) {
        self.plant.advance(1);
    }

    /// Lives through them as the actuators do: they hold, and then go safe.
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

/// An observer of the first body.
pub struct DeviceObserver<E: Estimator> {
    observer: Observer<E>,
}

impl<E: Estimator> DeviceObserver<E> {
    /// An observer at its initial guess, in the run of this greeting.
    pub fn new(estimator: E, hello: &Hello<'_>) -> Self {
        Self { observer: Observer::new(estimator, hello.period_ns as f64 / 1e9) }
    }

    /// The estimate of a tick. A measurement that is not there was not believed: nobody is asked where there was none.
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

/// A controller of N driven bodies.
pub struct DeviceController<L: Law, const N: usize> {
    controllers: [Controller<L>; N],
}

impl<L: Law<Measurement: Sample, Command: Sample>, const N: usize> DeviceController<L, N> {
    /// A controller with the law of each body.
    pub fn new(laws: [L; N]) -> Self {
        Self { controllers: laws.map(Controller::new) }
    }

    /// One command for each body whose measurement is there.
    fn command(&mut self, tick: u64, estimate: Option<&L::Estimate>, inputs: &mut Inputs<'_>, outputs: &mut Outputs) {
        for controller in &mut self.controllers {
            let measurement = inputs.take::<L::Measurement>(tick);
            let command = estimate.zip(measurement).map(|(estimate, measurement)| {
                let mut command = L::Command::default();
                controller.step(estimate, &measurement, &mut command);
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

/// Observer and controller in one device, a flight computer: measurements in, the estimate and the commands out.
pub struct DeviceFlightComputer<E: Estimator, L: Law, const N: usize> {
    observer: DeviceObserver<E>,
    controller: DeviceController<L, N>,
}

impl<E, L, const N: usize> DeviceFlightComputer<E, L, N>
where
    E: Estimator,
    L: Law<Estimate = E::Estimate, Measurement: Sample, Command: Sample>,
{
    /// Both at their beginnings, in the run of this greeting.
    pub fn new(estimator: E, laws: [L; N], hello: &Hello<'_>) -> Self {
        Self { observer: DeviceObserver::new(estimator, hello), controller: DeviceController::new(laws) }
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
