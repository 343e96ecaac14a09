//! Sources of a role's samples other than the built-in role: a function, or a device that computes the samples of
//! observer, controller or both in one exchange per tick.
//!
//! The roles keep their nodes with links, guards, watchdog and counters; only the content of their samples comes from
//! the source. Must not invent anything: a tick without an answer before the next one is due is missed.

use super::device::DeviceLink;
use super::error::NodeError;
use super::role_function::FunctionRole;
use crate::clock::{Grid, monotonic_ns};
use crate::sample::Stamp;
use crate::serial::{Answer, LineCounters, MAX_CONTENT, Samples};
use crate::telemetry::{Latency, Outage};
use std::cell::RefCell;
use std::rc::Rc;

/// Length of a stamp, words.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// State of a tick that is computed elsewhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    /// The samples are available.
    Done,
    /// Not yet available: poll again.
    Waiting,
    /// The tick has no samples.
    Missed,
}

/// A source of a role's samples in place of the built-in role.
pub(crate) enum SampleSource {
    /// A function; the role waits for its return.
    Function(Box<FunctionRole>),
    /// A device; the role polls until it answers.
    Device(DeviceHandle),
}

impl SampleSource {
    /// Sets the time grid, in real time.
    pub fn start(&mut self, grid: Grid) {
        if let Self::Device(handle) = self {
            handle.exchange.borrow_mut().grid = Some(grid);
        }
    }

    /// Computes or requests a tick from the samples that the role reads.
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
            Self::Device(handle) => handle.tick(tick, inputs),
        }
    }

    /// Returns true if the role's output `index` has a sample.
    pub fn has(&self, index: usize) -> bool {
        match self {
            Self::Function(_) => true,
            Self::Device(handle) => handle.exchange.borrow().outputs[handle.part.first_output() + index].there,
        }
    }

    /// Copies the role's output `index` into a sample, after the stamp.
    pub fn write(&self, index: usize, words: &mut [u64]) {
        match self {
            Self::Function(function) => function.write(index, words),
            Self::Device(handle) => {
                let exchange = handle.exchange.borrow();
                let bytes = &exchange.outputs[handle.part.first_output() + index].bytes;
                bytemuck::cast_slice_mut(&mut words[STAMP..]).copy_from_slice(bytes);
            }
        }
    }

    /// Returns the tick for which the device still lacks the controller's inputs besides the estimate.
    pub fn lacks(&self) -> Option<u64> {
        let Self::Device(handle) = self else { return None };
        let exchange = handle.exchange.borrow();
        exchange.tick.filter(|_| handle.part == Part::Controller && exchange.asked_ns.is_none())
    }

    /// Passes the controller's inputs to the device and sends the request.
    pub fn offer<'a>(&mut self, inputs: impl Iterator<Item = Option<&'a [u64]>>) {
        if let Self::Device(handle) = self {
            let exchange = &mut *handle.exchange.borrow_mut();
            exchange.put(handle.part, inputs);
            exchange.ask(monotonic_ns());
        }
    }

    /// Returns the time of the request for this tick, ns.
    pub fn asked_ns(&self, tick: u64) -> Option<u64> {
        let Self::Device(handle) = self else { return None };
        let exchange = handle.exchange.borrow();
        exchange.asked_ns.filter(|_| exchange.tick == Some(tick))
    }

    /// Returns true if the device also computes the estimate that this controller uses.
    pub fn makes_estimate(&self) -> bool {
        matches!(self, Self::Device(handle) if handle.part == Part::Controller)
    }

    /// Returns true while a request is open or incomplete.
    pub fn pending(&self) -> bool {
        let Self::Device(handle) = self else { return false };
        let exchange = handle.exchange.borrow();
        exchange.tick.is_some() && !exchange.answered
    }

    /// Returns true if the device lost the run and restarted from its initial state.
    pub fn restarted(&self) -> bool {
        let Self::Device(handle) = self else { return false };
        handle.exchange.borrow().link.counters().restarts > 0
    }

    /// Returns the device's outages, for the role that reports them.
    pub fn outages(&self) -> Vec<Outage> {
        match self {
            Self::Device(handle) if handle.part != Part::Controller => handle.exchange.borrow().link.outages(),
            _ => Vec::new(),
        }
    }

    /// Returns the line's counters and round-trip times, for the role that reports them.
    pub fn line(&self) -> Option<(LineCounters, Latency)> {
        let Self::Device(handle) = self else { return None };
        let exchange = handle.exchange.borrow();
        (handle.part != Part::Controller).then(|| (exchange.link.counters(), exchange.serial.clone()))
    }
}

/// The part of a device that a role uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    /// The whole device.
    All,
    /// The observer of a flight computer: first input measurement, first output estimate.
    Observer,
    /// The controller of a flight computer: all other inputs and outputs. The estimate stays in the device.
    Controller,
}

impl Part {
    fn first_output(self) -> usize {
        usize::from(self == Self::Controller)
    }
}

/// A role's handle on a device that roles may handle.
pub(crate) struct DeviceHandle {
    exchange: Rc<RefCell<Exchange>>,
    part: Part,
}

impl DeviceHandle {
    /// Creates the handle of a device with one role.
    pub fn all(link: Box<DeviceLink>) -> Self {
        Self { exchange: Rc::new(RefCell::new(Exchange::new(link))), part: Part::All }
    }

    /// Creates the handles of a device that is observer and controller.
    pub fn both(link: Box<DeviceLink>) -> [Self; 2] {
        let exchange = Rc::new(RefCell::new(Exchange::new(link)));
        [Part::Observer, Part::Controller].map(|part| Self { exchange: Rc::clone(&exchange), part })
    }

    fn tick<'a>(&mut self, tick: u64, inputs: impl Iterator<Item = Option<&'a [u64]>>) -> Result<Progress, NodeError> {
        let (exchange, now_ns) = (&mut *self.exchange.borrow_mut(), monotonic_ns());
        if exchange.tick != Some(tick) {
            exchange.begin(tick);
            exchange.put(self.part, inputs);
            // The observer's measurement is sent together with the controller's inputs.
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

/// The content of a sample, if present.
struct Content {
    bytes: Vec<u8>,
    there: bool,
}

/// The inputs and outputs of a device at one tick.
struct Exchange {
    link: Box<DeviceLink>,
    /// The time grid, in real time.
    grid: Option<Grid>,
    inputs: Vec<Content>,
    outputs: Vec<Content>,
    /// The current tick; the time of its request, ns; true once answered.
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

    /// Ends the current tick and its request.
    fn end(&mut self) {
        if let Some(asked_ns) = self.asked_ns.filter(|_| !self.answered) {
            self.link.give_up();
            if self.grid.is_some() {
                self.serial.record_missed(asked_ns, monotonic_ns());
            }
        }
        (self.tick, self.asked_ns, self.answered) = (None, None, false);
    }

    /// Stores the inputs of one role; for the controller of a flight computer all but the estimate.
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

    /// Serves the line while a request is open.
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

/// Stores an answer. Its lengths match the agreed ones: the host's end drops others.
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
