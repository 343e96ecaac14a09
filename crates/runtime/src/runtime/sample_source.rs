//! A device that computes the samples of the observer, of the controller, or of both: one exchange per tick, whoever of them
//! begins it.
//!
//! The roles stay the nodes that they are, with links, guards, watchdog and counters; only what they send comes from the
//! device. Must not invent anything: what is not answered before the next tick is due is missed.

use super::device::DeviceLink;
use super::error::NodeError;
use super::role_function::FunctionRole;
use crate::clock::{Grid, monotonic_ns};
use crate::sample::Stamp;
use crate::serial::{Answer, LineCounters, MAX_CONTENT, Samples};
use crate::telemetry::{Latency, Outage};
use std::cell::RefCell;
use std::rc::Rc;

/// Words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// What became of a tick that somebody else computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    /// It is there, to be written.
    Done,
    /// It is not there yet: ask again.
    Waiting,
    /// It will not be there.
    Missed,
}

/// Who computes a role's samples in the place of our own.
pub(crate) enum SampleSource {
    /// A function, which is waited for.
    Function(FunctionRole),
    /// A device, which is asked until it has answered.
    Device(DeviceHandle),
}

impl SampleSource {
    /// Hands over the time grid; in real time.
    pub fn start(&mut self, grid: Grid) {
        if let Self::Device(share) = self {
            share.exchange.borrow_mut().grid = Some(grid);
        }
    }

    /// Computes a tick, or asks for it, with the samples that the role reads.
    #[inline]
    pub fn tick<'a>(
        &mut self,
        tick: u64,
        inputs: impl Iterator<Item = Option<&'a [u64]>>,
    ) -> Result<Progress, NodeError> {
        match self {
            Self::Function(function) => {
                let inputs: Vec<Option<&[u64]>> = inputs.collect();
                function.tick(tick, &inputs).map(|()| Progress::Done)
            }
            Self::Device(share) => share.tick(tick, inputs),
        }
    }

    /// Whether there is a sample with this index, in the order of what the role writes.
    pub fn has(&self, index: usize) -> bool {
        match self {
            Self::Function(_) => true,
            Self::Device(share) => share.exchange.borrow().outputs[share.part.first_output() + index].there,
        }
    }

    /// Writes what was computed into a sample, after its stamp.
    pub fn write(&self, index: usize, words: &mut [u64]) {
        match self {
            Self::Function(function) => function.write(index, words),
            Self::Device(share) => {
                let exchange = share.exchange.borrow();
                let bytes = &exchange.outputs[share.part.first_output() + index].bytes;
                bytemuck::cast_slice_mut(&mut words[STAMP..]).copy_from_slice(bytes);
            }
        }
    }

    /// The tick of which the device waits for what this role, a controller, reads beside the estimate.
    pub fn lacks(&self) -> Option<u64> {
        let Self::Device(share) = self else { return None };
        let exchange = share.exchange.borrow();
        exchange.tick.filter(|_| share.part == Part::Controller && exchange.asked_ns.is_none())
    }

    /// Gives it that, and asks.
    pub fn offer<'a>(&mut self, inputs: impl Iterator<Item = Option<&'a [u64]>>) {
        if let Self::Device(share) = self {
            let exchange = &mut *share.exchange.borrow_mut();
            exchange.put(share.part, inputs);
            exchange.ask(monotonic_ns());
        }
    }

    /// When the device was asked for this tick, ns.
    pub fn asked_ns(&self, tick: u64) -> Option<u64> {
        let Self::Device(share) = self else { return None };
        let exchange = share.exchange.borrow();
        exchange.asked_ns.filter(|_| exchange.tick == Some(tick))
    }

    /// Returns true if the device makes the estimate that this role, a controller, works on.
    pub fn makes_estimate(&self) -> bool {
        matches!(self, Self::Device(share) if share.part == Part::Controller)
    }

    /// Whether an answer is waited for, or what is to be asked.
    pub fn pending(&self) -> bool {
        let Self::Device(share) = self else { return false };
        let exchange = share.exchange.borrow();
        exchange.tick.is_some() && !exchange.answered
    }

    /// Whether the device has lost the run, and begun anew.
    pub fn restarted(&self) -> bool {
        let Self::Device(share) = self else { return false };
        share.exchange.borrow().link.counters().restarts > 0
    }

    /// When the device was absent, for the role that tells it.
    pub fn outages(&self) -> Vec<Outage> {
        match self {
            Self::Device(share) if share.part != Part::Controller => share.exchange.borrow().link.outages(),
            _ => Vec::new(),
        }
    }

    /// The counters of the line and its round trips, for the role that tells them.
    pub fn line(&self) -> Option<(LineCounters, Latency)> {
        let Self::Device(share) = self else { return None };
        let exchange = share.exchange.borrow();
        (share.part != Part::Controller).then(|| (exchange.link.counters(), exchange.serial.clone()))
    }
}

/// Which of the device's roles a role is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    /// The only one.
    All,
    /// The observer of a flight computer: its measurement is the first input, its estimate the first output.
    Observer,
    /// The controller of a flight computer: it has all the others, and the estimate from the device itself.
    Controller,
}

impl Part {
    fn first_output(self) -> usize {
        usize::from(self == Self::Controller)
    }
}

/// One role's share of a device.
pub(crate) struct DeviceHandle {
    exchange: Rc<RefCell<Exchange>>,
    part: Part,
}

impl DeviceHandle {
    /// The only role of a device.
    pub fn all(link: Box<DeviceLink>) -> Self {
        Self { exchange: Rc::new(RefCell::new(Exchange::new(link))), part: Part::All }
    }

    /// Observer and controller of a device.
    pub fn both(link: Box<DeviceLink>) -> [Self; 2] {
        let exchange = Rc::new(RefCell::new(Exchange::new(link)));
        [Part::Observer, Part::Controller].map(|part| Self { exchange: Rc::clone(&exchange), part })
    }

    fn tick<'a>(&mut self, tick: u64, inputs: impl Iterator<Item = Option<&'a [u64]>>) -> Result<Progress, NodeError> {
        let (exchange, now_ns) = (&mut *self.exchange.borrow_mut(), monotonic_ns());
        if exchange.tick != Some(tick) {
            exchange.begin(tick);
            exchange.put(self.part, inputs);
            // The observer's measurement goes together with the others.
            if self.part != Part::Observer {
                exchange.ask(now_ns);
            }
        }
        exchange.look(now_ns)?;
        if exchange.answered {
            return Ok(Progress::Done);
        }
        let overdue = exchange.grid.is_some_and(|grid| now_ns >= grid.due_ns(tick + 1));
        if overdue {
            exchange.end();
        }
        Ok(if overdue { Progress::Missed } else { Progress::Waiting })
    }
}

/// The content of a sample, if it is there.
struct Content {
    bytes: Vec<u8>,
    there: bool,
}

/// What passes between the host and such a device at one tick.
struct Exchange {
    link: Box<DeviceLink>,
    /// In real time.
    grid: Option<Grid>,
    inputs: Vec<Content>,
    outputs: Vec<Content>,
    /// The tick at hand; when it was asked for, ns; whether it was answered.
    tick: Option<u64>,
    asked_ns: Option<u64>,
    answered: bool,
    serial: Latency,
}

impl Exchange {
    fn new(link: Box<DeviceLink>) -> Self {
        let contents = |lengths: &[usize]| {
            lengths.iter().map(|length| Content { bytes: vec![0; *length], there: false }).collect::<Vec<_>>()
        };
        let (inputs, outputs) = (contents(link.inputs()), contents(&link.outputs()));
        Self {
            link,
            grid: None,
            inputs,
            outputs,
            tick: None,
            asked_ns: None,
            answered: false,
            serial: Latency::default(),
        }
    }

    fn begin(&mut self, tick: u64) {
        self.end();
        self.tick = Some(tick);
        self.inputs.iter_mut().for_each(|input| input.there = false);
    }

    /// Asks no more for the tick at hand.
    fn end(&mut self) {
        if let Some(asked_ns) = self.asked_ns.filter(|_| !self.answered) {
            self.link.give_up();
            if self.grid.is_some() {
                self.serial.record_missed(asked_ns, monotonic_ns());
            }
        }
        (self.tick, self.asked_ns, self.answered) = (None, None, false);
    }

    /// Takes what one role reads; of a flight computer's controller all but the estimate.
    fn put<'a>(&mut self, part: Part, samples: impl Iterator<Item = Option<&'a [u64]>>) {
        let (own, first) = match part {
            Part::All => (&mut self.inputs[..], 0),
            Part::Observer => (&mut self.inputs[..1], 0),
            Part::Controller => (&mut self.inputs[1..], 1),
        };
        for (input, sample) in own.iter_mut().zip(samples.skip(first)) {
            input.there = sample.is_some();
            if let Some(sample) = sample {
                input.bytes.copy_from_slice(bytemuck::cast_slice(&sample[STAMP..]));
            }
        }
    }

    fn ask(&mut self, now_ns: u64) {
        let Some(tick) = self.tick else { return };
        let (mut bytes, mut length, mut present) = ([0; MAX_CONTENT], 0, 0);
        for (index, input) in self.inputs.iter().enumerate().filter(|(_, input)| input.there) {
            bytes[length..length + input.bytes.len()].copy_from_slice(&input.bytes);
            length += input.bytes.len();
            present |= 1 << index;
        }
        self.link.request(tick, Samples { present, bytes: &bytes[..length] }, now_ns);
        self.asked_ns = Some(now_ns);
    }

    /// Serves the line.
    fn look(&mut self, now_ns: u64) -> Result<(), NodeError> {
        let Some(asked_ns) = self.asked_ns.filter(|_| !self.answered) else { return Ok(()) };
        let Self { link, outputs, answered, .. } = self;
        link.turn(now_ns, |answer| {
            take(outputs, answer);
            *answered = true;
        })?;
        if self.answered && self.grid.is_some() {
            self.serial.record(asked_ns, now_ns);
        }
        Ok(())
    }
}

/// The lengths are those agreed upon: the host's end drops other answers.
fn take(outputs: &mut [Content], answer: &Answer<'_>) {
    let mut bytes = answer.outputs.bytes;
    for (index, output) in outputs.iter_mut().enumerate() {
        output.there = answer.outputs.present >> index & 1 == 1;
        if let Some((content, rest)) = bytes.split_at_checked(output.bytes.len()).filter(|_| output.there) {
            output.bytes.copy_from_slice(content);
            bytes = rest;
        }
    }
}
