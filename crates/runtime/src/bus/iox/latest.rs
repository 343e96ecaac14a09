//! The latest-value channel of a signal: its newest sample on an iceoryx2 blackboard.
//!
//! A reader of the newest sample finds it here earlier than in its queue, and polls without touching a queue. Every
//! sample is also published, for readers of all samples and for foreign programs. A blackboard whose writer died cannot
//! be written again while a reader uses it, so each generation of a writer has its own.

use super::opening::OpenFailure;
use super::service::{Ipc, MAX_NODES, MAX_READERS, Wire};
use crate::bus::names::Topic;
use crate::sample::Sample;
use iceoryx2::node::Node;
use iceoryx2::port::reader::{BlackboardValue, EntryHandle};
use iceoryx2::port::writer::EntryHandleMut;
use iceoryx2::prelude::*;

/// The only key of a blackboard.
const KEY: u64 = 0;

/// The writing end.
pub struct LatestWriter<S: Sample>(EntryHandleMut<Ipc, u64, Wire<S>>);

impl<S: Sample> LatestWriter<S> {
    /// Creates the channel of the writer's `generation`.
    pub fn create(node: &Node<Ipc>, topic: &Topic, generation: u64) -> Result<Self, OpenFailure> {
        let service = node
            .service_builder(&name(topic, generation).map_err(OpenFailure::never)?)
            .blackboard_creator::<u64>()
            .max_readers(MAX_READERS)
            .max_nodes(MAX_NODES)
            .add::<Wire<S>>(KEY, Wire(S::zeroed()))
            .create()?;
        let writer = service.writer_builder().create().map_err(OpenFailure::never)?;
        writer.entry::<Wire<S>>(&KEY).map(Self).map_err(OpenFailure::never)
    }

    /// Writes a sample.
    #[inline]
    pub fn put(&self, sample: &S) {
        self.0.update_with_copy(Wire(*sample));
    }
}

/// The reading end with its current sample.
pub struct LatestReader<S: Sample> {
    entry: EntryHandle<Ipc, u64, Wire<S>>,
    value: BlackboardValue<Wire<S>>,
    /// True until the first read: the initial content then counts as new.
    fresh: bool,
    generation: u64,
}

impl<S: Sample> LatestReader<S> {
    /// Opens the channel of a writer of `generation`; `None` if it does not exist, as with a foreign writer.
    pub fn open(node: &Node<Ipc>, topic: &Topic, generation: u64) -> Option<Self> {
        let service = node.service_builder(&name(topic, generation).ok()?).blackboard_opener::<u64>().open().ok()?;
        let entry = service.reader_builder().create().ok()?.entry::<Wire<S>>(&KEY).ok()?;
        let value = entry.get();
        Some(Self { entry, value, fresh: true, generation })
    }

    /// Returns the writer's generation.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Returns true if a newer sample than the current one may exist.
    #[inline]
    pub fn has_news(&self) -> bool {
        self.fresh || !self.entry.is_up_to_date(&self.value)
    }

    /// Reads the newest sample; returns false if that is the current one.
    #[inline]
    pub fn advance(&mut self) -> bool {
        let news = self.has_news();
        if news {
            self.value = self.entry.get();
            self.fresh = false;
        }
        news
    }

    /// Returns the current sample.
    #[inline]
    pub fn sample(&self) -> &S {
        &self.value.0
    }
}

fn name(topic: &Topic, generation: u64) -> Result<ServiceName, String> {
    format!("{topic}/latest/{generation}").as_str().try_into().map_err(|error| format!("{error:?}"))
}
