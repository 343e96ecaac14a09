//! The fast lane beside a signal: its latest sample, and nothing else, on an iceoryx2 blackboard.
//!
//! A reader that wants the newest sample only finds it here sooner than in its queue, and looks without touching a queue.
//! Every sample still goes out by publish-subscribe, for those who want all of them and for programs that are not ours. A
//! blackboard that its writer died on cannot be written again while anybody reads it, so each generation of a writer has
//! one of its own.

use super::opening::OpenFailure;
use super::service::{Ipc, MAX_NODES, MAX_READERS, Wire};
use crate::bus::Topic;
use crate::sample::Sample;
use iceoryx2::node::Node;
use iceoryx2::port::reader::{BlackboardValue, EntryHandle};
use iceoryx2::port::writer::EntryHandleMut;
use iceoryx2::prelude::*;

/// A blackboard of ours has one entry.
const KEY: u64 = 0;

/// The writing end.
pub struct LatestWriter<S: Sample>(EntryHandleMut<Ipc, u64, Wire<S>>);

impl<S: Sample> LatestWriter<S> {
    /// A new lane, of the writer's `generation`.
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

    /// Puts a sample there.
    #[inline]
    pub fn put(&self, sample: &S) {
        self.0.update_with_copy(Wire(*sample));
    }
}

/// The reading end, with the sample at hand.
pub struct LatestReader<S: Sample> {
    entry: EntryHandle<Ipc, u64, Wire<S>>,
    value: BlackboardValue<Wire<S>>,
    /// Nothing has been taken yet: also what was there before counts as news.
    fresh: bool,
    generation: u64,
}

impl<S: Sample> LatestReader<S> {
    /// The lane of a writer of `generation`; none if there is none, as where the writer is no program of ours.
    pub fn open(node: &Node<Ipc>, topic: &Topic, generation: u64) -> Option<Self> {
        let service = node.service_builder(&name(topic, generation).ok()?).blackboard_opener::<u64>().open().ok()?;
        let entry = service.reader_builder().create().ok()?.entry::<Wire<S>>(&KEY).ok()?;
        let value = entry.get();
        Some(Self { entry, value, fresh: true, generation })
    }

    /// The writer's generation.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Whether there may be another sample than the one at hand.
    #[inline]
    pub fn has_news(&self) -> bool {
        self.fresh || !self.entry.is_up_to_date(&self.value)
    }

    /// Takes the newest sample; false if that is at hand.
    #[inline]
    pub fn advance(&mut self) -> bool {
        let news = self.has_news();
        if news {
            self.value = self.entry.get();
            self.fresh = false;
        }
        news
    }

    /// The sample at hand.
    #[inline]
    pub fn sample(&self) -> &S {
        &self.value.0
    }
}

fn name(topic: &Topic, generation: u64) -> Result<ServiceName, String> {
    format!("{topic}/latest/{generation}").as_str().try_into().map_err(|error| format!("{error:?}"))
}
