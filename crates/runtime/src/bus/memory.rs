//! The bus within one thread: the semantics of [`super::iox`] without shared memory or files.

use super::carried::FleetBuffer;
use super::error::BusError;
use super::link::{Bus, Depths, Read, Reader, Write};
use super::names::Topic;
use crate::sample::{FleetLayout, FleetSample, Sample};
use std::any::Any;
use std::cell::RefCell;
use std::collections::{HashMap, VecDeque};
use std::rc::Rc;

/// One reader's waiting samples, the newest last. At full depth the oldest is dropped.
struct ReaderQueue<S> {
    samples: VecDeque<S>,
    depth: usize,
}

type Queue<S> = Rc<RefCell<ReaderQueue<S>>>;
/// The queues of a signal's readers. The next reader takes over the queue of a dropped one with its samples: a rebuilt
/// role takes its predecessor's place.
type Queues<S> = Rc<RefCell<Vec<Queue<S>>>>;

/// A bus within one thread.
pub struct MemoryBus {
    depths: Depths,
    topics: RefCell<HashMap<String, Box<dyn Any>>>,
}

impl MemoryBus {
    /// Creates a bus without signals.
    pub fn new(depths: Depths) -> Self {
        Self { depths, topics: RefCell::new(HashMap::new()) }
    }

    fn queues<T: 'static>(&self, topic: &Topic, end: &'static str, type_name: &str) -> Result<Queues<T>, BusError> {
        let service = topic.to_string();
        let mut topics = self.topics.borrow_mut();
        let entry = topics.entry(service.clone()).or_insert_with(|| Box::new(Queues::<T>::default()));
        entry.downcast_ref::<Queues<T>>().cloned().ok_or_else(|| BusError::Open {
            service,
            end,
            reason: format!("its samples are not of type {type_name}"),
        })
    }

    fn read<T: 'static>(&self, topic: &Topic, reader: Reader, type_name: &str) -> Result<MemoryReader<T>, BusError> {
        let depth = self.depths.for_reader(reader);
        let queues = self.queues(topic, "reader", type_name)?;
        let orphan = |queue: &&Queue<T>| Rc::strong_count(queue) == 1 && queue.borrow().depth == depth;
        let found = queues.borrow().iter().find(orphan).cloned();
        let queue = found.unwrap_or_else(|| {
            let queue: Queue<T> = Rc::new(RefCell::new(ReaderQueue { samples: VecDeque::with_capacity(depth), depth }));
            queues.borrow_mut().push(queue.clone());
            queue
        });
        Ok(MemoryReader { queue, current: None })
    }
}

impl Bus for MemoryBus {
    const REPEATS: bool = false;
    type Writer<S: Sample> = MemoryWriter<S>;
    type Reader<S: Sample> = MemoryReader<S>;
    type FleetWriter<L: FleetLayout> = MemoryFleetWriter<L>;
    type FleetReader<L: FleetLayout> = MemoryReader<Rc<FleetBuffer<L>>>;

    fn writer<S: Sample>(&self, topic: &Topic, _generation: u64) -> Result<MemoryWriter<S>, BusError> {
        Ok(MemoryWriter { queues: self.queues(topic, "writer", S::TYPE_NAME)?, slot: S::default() })
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<MemoryReader<S>, BusError> {
        self.read(topic, reader, S::TYPE_NAME)
    }

    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<MemoryFleetWriter<L>, BusError> {
        Ok(MemoryFleetWriter {
            queues: self.queues(topic, "writer", L::TYPE_NAME)?,
            chunks: Vec::new(),
            filled: 0,
            bodies,
        })
    }

    fn fleet_reader<L: FleetLayout>(
        &self,
        topic: &Topic,
        reader: Reader,
        _bodies: usize,
    ) -> Result<Self::FleetReader<L>, BusError> {
        self.read(topic, reader, L::TYPE_NAME)
    }
}

/// Adds a sample to the queue of every reader.
#[inline]
fn push_to_all<T: Clone>(queues: &Queues<T>, sample: &T) {
    for queue in queues.borrow().iter() {
        let mut queue = queue.borrow_mut();
        if queue.samples.len() == queue.depth {
            queue.samples.pop_front();
        }
        queue.samples.push_back(sample.clone());
    }
}

/// The writing end.
pub struct MemoryWriter<S> {
    queues: Queues<S>,
    slot: S,
}

impl<S: Sample> Write<S> for MemoryWriter<S> {
    #[inline]
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        fill(&mut self.slot);
        Ok(())
    }

    #[inline]
    fn deliver(&mut self) -> Result<(), BusError> {
        push_to_all(&self.queues, &self.slot);
        Ok(())
    }

    fn prepare(&mut self) -> Result<(), BusError> {
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        Ok(())
    }
}

/// The writing end of a fleet's signal. Readers share the written buffers; a buffer that no reader uses is reused.
pub struct MemoryFleetWriter<L> {
    queues: Queues<Rc<FleetBuffer<L>>>,
    chunks: Vec<Rc<FleetBuffer<L>>>,
    /// Index of the buffer filled last.
    filled: usize,
    bodies: usize,
}

impl<L: FleetLayout> Write<FleetSample<L>> for MemoryFleetWriter<L> {
    fn fill(&mut self, fill: impl FnOnce(&mut FleetSample<L>)) -> Result<(), BusError> {
        let free = self.chunks.iter().position(|chunk| Rc::strong_count(chunk) == 1);
        self.filled = free.unwrap_or(self.chunks.len());
        if free.is_none() {
            self.chunks.push(Rc::new(FleetBuffer::new(self.bodies)));
        }
        if let Some(chunk) = Rc::get_mut(&mut self.chunks[self.filled]) {
            fill(chunk.sample_mut());
        }
        Ok(())
    }

    fn deliver(&mut self) -> Result<(), BusError> {
        if let Some(chunk) = self.chunks.get(self.filled) {
            push_to_all(&self.queues, chunk);
        }
        Ok(())
    }

    fn prepare(&mut self) -> Result<(), BusError> {
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        Ok(())
    }
}

/// The reading end.
pub struct MemoryReader<T> {
    queue: Queue<T>,
    current: Option<T>,
}

impl<T> MemoryReader<T> {
    #[inline]
    fn next(&mut self) -> bool {
        let next = self.queue.borrow_mut().samples.pop_front();
        let moved = next.is_some();
        if moved {
            self.current = next;
        }
        moved
    }
}

impl<S: Sample> Read<S> for MemoryReader<S> {
    #[inline]
    fn advance(&mut self) -> Result<bool, BusError> {
        Ok(self.next())
    }

    #[inline]
    fn current(&self) -> Option<&S> {
        self.current.as_ref()
    }

    fn sleep(&mut self, _until_ns: u64) -> Result<(), BusError> {
        Ok(())
    }

    fn refresh(&mut self) {}
}

impl<L: FleetLayout> Read<FleetSample<L>> for MemoryReader<Rc<FleetBuffer<L>>> {
    fn advance(&mut self) -> Result<bool, BusError> {
        Ok(self.next())
    }

    fn current(&self) -> Option<&FleetSample<L>> {
        self.current.as_deref().map(FleetBuffer::sample)
    }

    fn sleep(&mut self, _until_ns: u64) -> Result<(), BusError> {
        Ok(())
    }

    fn refresh(&mut self) {}
}

#[cfg(test)]
mod tests {
    use super::super::Signal;
    use super::*;
    use crate::sample::{RateCommand, RateTruth};

    fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command }
    }

    #[test]
    fn a_deep_reader_gets_every_sample_in_order_and_a_shallow_one_the_newest() {
        let bus = MemoryBus::new(Depths { role: 1, scorer: 8, history: 0 });
        let mut newest = bus.reader::<RateCommand>(&topic(), Reader::Role).unwrap();
        let mut every = bus.reader::<RateCommand>(&topic(), Reader::Scorer).unwrap();
        let mut writer = bus.writer::<RateCommand>(&topic(), 1).unwrap();
        assert!(!newest.advance().unwrap() && newest.current().is_none());
        for tick in 0..5 {
            writer.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        assert!(newest.advance().unwrap());
        assert_eq!(newest.current().unwrap().stamp.tick, 4);
        assert!(!newest.advance().unwrap());
        assert_eq!(newest.current().unwrap().stamp.tick, 4, "the current sample stays");
        for tick in 0..5 {
            assert!(every.advance().unwrap());
            assert_eq!(every.current().unwrap().stamp.tick, tick);
        }
    }

    #[test]
    fn a_new_reader_takes_over_the_queue_of_a_dropped_one() {
        let bus = MemoryBus::new(Depths { role: 4, scorer: 8, history: 0 });
        let open = || bus.reader::<RateCommand>(&topic(), Reader::Role).unwrap();
        let mut writer = bus.writer::<RateCommand>(&topic(), 1).unwrap();
        let mut first = open();
        for tick in 0..3 {
            writer.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        first.advance().unwrap();
        drop(first);
        let mut second = open();
        assert!(second.advance().unwrap());
        assert_eq!(second.current().unwrap().stamp.tick, 1);
        assert!(!open().advance().unwrap(), "a second reader starts with an empty queue");
    }

    #[test]
    fn refuses_a_signal_of_another_type() {
        let bus = MemoryBus::new(Depths { role: 1, scorer: 8, history: 0 });
        bus.writer::<RateCommand>(&topic(), 1).unwrap();
        assert!(matches!(bus.reader::<RateTruth>(&topic(), Reader::Role), Err(BusError::Open { .. })));
    }
}
