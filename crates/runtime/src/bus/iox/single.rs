//! Links of single bodies over shared memory: a queue of samples, and a latest-value channel.

use super::cause;
use super::latest::{LatestReader, LatestWriter};
use super::service::{Ipc, Wire, has_writer, writer};
use crate::bus::error::BusError;
use crate::bus::link::{Read, Write, WriterProcess};
use crate::bus::names::Topic;
use crate::bus::notifier::Notifier;
use crate::sample::{NO_SAMPLE, Sample};
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::sample::Sample as Received;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::rc::Rc;

/// The writing end.
pub struct IoxWriter<S: Sample> {
    pub(super) publisher: Publisher<Ipc, Wire<S>, ()>,
    pub(super) latest: Option<LatestWriter<S>>,
    pub(super) loan: Option<SampleMut<Ipc, Wire<S>, ()>>,
    /// A sample that is in the latest-value channel and not published.
    pub(super) unpublished: Option<SampleMut<Ipc, Wire<S>, ()>>,
    pub(super) notifier: Notifier,
    pub(super) topic: Topic,
}

impl<S: Sample> IoxWriter<S> {
    /// Takes the filled sample and writes it to the latest-value channel, if any.
    #[inline]
    fn filled(&mut self) -> Option<SampleMut<Ipc, Wire<S>, ()>> {
        let sample = self.loan.take()?;
        if let Some(latest) = &self.latest {
            latest.put(&sample.payload().0);
            // A reader of the channel need not wait for the queues.
            self.notifier.notify();
        }
        Some(sample)
    }

    #[inline]
    fn queue(&self, sample: SampleMut<Ipc, Wire<S>, ()>) -> Result<(), BusError> {
        sample.send().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        self.notifier.notify();
        Ok(())
    }

    fn loan(&self) -> Result<SampleMut<Ipc, Wire<S>, ()>, BusError> {
        let chunk =
            self.publisher.loan_uninit().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        Ok(chunk.write_payload(Wire(S::zeroed())))
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Send { service: self.topic.to_string(), reason }
    }
}

impl<S: Sample> Write<S> for IoxWriter<S> {
    #[inline]
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let mut sample = match self.loan.take() {
            Some(sample) => sample,
            None => self.loan()?,
        };
        fill(&mut sample.payload_mut().0);
        self.loan = Some(sample);
        Ok(())
    }

    #[inline]
    fn deliver(&mut self) -> Result<(), BusError> {
        let sample = self.filled();
        sample.map_or(Ok(()), |sample| self.queue(sample))
    }

    #[inline]
    fn write_latest(&mut self) -> Result<(), BusError> {
        self.publish()?;
        self.unpublished = self.filled();
        if self.latest.is_none() { self.publish() } else { Ok(()) }
    }

    #[inline]
    fn publish(&mut self) -> Result<(), BusError> {
        self.unpublished.take().map_or(Ok(()), |sample| self.queue(sample))
    }

    /// Loans the memory of the next sample: the one small allocation of iceoryx2 per sample happens here, off the
    /// critical path.
    #[inline]
    fn prepare(&mut self) -> Result<(), BusError> {
        if self.loan.is_none() {
            self.loan = Some(self.loan()?);
        }
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.publisher.update_connections().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))
    }
}

/// Number of polls of the channel between two polls of the queue, which is usually empty.
const LOOKS: u32 = 256;

/// The reading end.
pub struct IoxReader<S: Sample> {
    pub(super) node: Rc<Node<Ipc>>,
    pub(super) service: PortFactory<Ipc, Wire<S>, ()>,
    pub(super) subscriber: Subscriber<Ipc, Wire<S>, ()>,
    pub(super) latest_channel: LatestChannel<S>,
    /// Number of polls of the channel without a new sample.
    pub(super) idle: u32,
    pub(super) current: Current<S>,
    /// Generation and tick of the last two samples from the channel, newer first.
    pub(super) channel_keys: [(u64, u64); 2],
    /// A sample taken from the queue before a sleep, not returned yet.
    pub(super) pending: Option<Received<Ipc, Wire<S>, ()>>,
    /// Generation and tick of the last returned sample.
    pub(super) newest: (u64, u64),
    pub(super) notifier: Notifier,
    pub(super) topic: Topic,
}

/// A reader's latest-value channel.
#[allow(clippy::large_enum_variant, reason = "there is one per reader, and it is looked at at every tick")]
pub(super) enum LatestChannel<S: Sample> {
    /// The signal has no channel.
    None,
    /// The channel of a writer of this generation is not open yet.
    Wanted { generation: u64 },
    /// The channel is open.
    Open(LatestReader<S>),
}

/// Returns generation and tick, which identify and order the samples of a signal.
#[inline]
fn key(sample: &impl Sample) -> (u64, u64) {
    let stamp = sample.stamp();
    (stamp.generation & !NO_SAMPLE, stamp.tick)
}

/// A key that no sample has.
pub(super) const NO_KEY: (u64, u64) = (u64::MAX, u64::MAX);

/// Returns true if a sample of this key in the queue was already read from the channel.
///
/// A writer serves the channel before the queue, so the queue may hold the sample before the one in the channel. Keys
/// do not decide their order: a scripted fault may have delayed the one in the channel.
#[inline]
fn is_overtaken<S: Sample>(channel: &LatestChannel<S>, channel_keys: &[(u64, u64); 2], key: (u64, u64)) -> bool {
    channel_keys.contains(&key) || matches!(channel, LatestChannel::Open(latest) if key <= self::key(latest.sample()))
}

/// The location of the current sample.
pub(super) enum Current<S: Sample> {
    None,
    InLane,
    Queued(Received<Ipc, Wire<S>, ()>),
}

impl<S: Sample> IoxReader<S> {
    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Receive { service: self.topic.to_string(), reason }
    }

    /// Takes the next sample from the queue that was not read from the channel.
    fn receive(&mut self) -> Result<bool, BusError> {
        let (received, key) = loop {
            let received = match self.pending.take() {
                Some(sample) => sample,
                None => match self.subscriber.receive() {
                    Ok(Some(sample)) => sample,
                    Ok(None) => return Ok(false),
                    Err(error) => return Err(self.failed(cause::reason(|| format!("{error:?}")))),
                },
            };
            let key = key(&received.payload().0);
            if !is_overtaken(&self.latest_channel, &self.channel_keys, key) {
                break (received, key);
            }
        };
        let (generation, _) = key;
        match &mut self.latest_channel {
            LatestChannel::Open(latest) if generation > latest.generation() => {
                self.latest_channel = LatestChannel::Wanted { generation }
            }
            // A warm-up sample does not identify its writer.
            LatestChannel::Wanted { generation: wanted } if generation > 0 => *wanted = generation,
            _ => {}
        }
        self.newest = key;
        self.current = Current::Queued(received);
        Ok(true)
    }
}

impl<S: Sample> Read<S> for IoxReader<S> {
    #[inline]
    fn advance(&mut self) -> Result<bool, BusError> {
        if let LatestChannel::Open(latest) = &mut self.latest_channel
            && self.pending.is_none()
        {
            if latest.advance() {
                let key = key(latest.sample());
                self.channel_keys = [key, self.channel_keys[0]];
                let before = std::mem::replace(&mut self.newest, key);
                self.current = Current::InLane;
                // The queue may have been faster, and the channel may return one sample twice.
                return Ok(self.newest != before);
            }
            self.idle = self.idle.wrapping_add(1);
            if !self.idle.is_multiple_of(LOOKS) {
                return Ok(false);
            }
        }
        self.receive()
    }

    #[inline]
    fn current(&self) -> Option<&S> {
        match (&self.current, &self.latest_channel) {
            (Current::Queued(sample), _) => Some(&sample.payload().0),
            (Current::InLane, LatestChannel::Open(latest)) => Some(latest.sample()),
            _ => None,
        }
    }

    fn has_writer(&self) -> bool {
        has_writer(&self.service)
    }

    fn writer(&self) -> Option<WriterProcess> {
        writer(&self.service)
    }

    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        let Self { subscriber, latest_channel: channel, channel_keys, idle, pending, notifier, topic, .. } = self;
        let failed = |reason| BusError::Receive { service: topic.to_string(), reason };
        let LatestChannel::Open(latest) = &*channel else {
            return notifier.sleep(until_ns, || {
                subscriber.has_samples().map_err(|error| failed(cause::reason(|| format!("{error:?}"))))
            });
        };
        notifier.sleep(until_ns, || {
            // Samples read from the channel also wait in the queue. They are discarded, otherwise every sleep would end
            // at once.
            while !latest.has_news() && pending.is_none() {
                match subscriber.receive() {
                    Ok(Some(sample)) => {
                        *pending =
                            Some(sample).filter(|sample| !is_overtaken(channel, channel_keys, key(&sample.payload().0)))
                    }
                    Ok(None) => return Ok(false),
                    Err(error) => return Err(failed(cause::reason(|| format!("{error:?}")))),
                }
            }
            // The next poll reads the queue if the channel has nothing new.
            *idle = u32::MAX;
            Ok(true)
        })
    }

    fn refresh(&mut self) {
        // Otherwise the first poll of the queue after the channel is open would connect to the writer during a tick.
        // That poll reports errors.
        let _ = self.subscriber.update_connections();
        // A reader that polls once per tick would otherwise find a new writer only after many ticks.
        self.idle = u32::MAX;
        if let LatestChannel::Wanted { generation } = self.latest_channel {
            match LatestReader::open(&self.node, &self.topic, generation) {
                Some(latest) => self.latest_channel = LatestChannel::Open(latest),
                // A writer creates its channel before its signal, so a missing channel will stay missing. Before the
                // first sample the writer's generation is unknown.
                None if self.newest != (0, 0) => self.latest_channel = LatestChannel::None,
                None => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{bus, topic};
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::{Bus, Reader, Signal};
    use crate::clock::monotonic_ns;
    use crate::sample::RateCommand;

    /// A signal with a latest-value channel.
    fn fast() -> Topic {
        Topic { signal: Signal::Command, ..topic() }
    }

    fn send(writer: &mut IoxWriter<RateCommand>, tick: u64, generation: u64) {
        writer.send(|sample| (sample.stamp.tick, sample.stamp.generation) = (tick, generation)).unwrap();
    }

    /// The queue still holds the sample read from the channel. That must not end the sleep.
    #[test]
    fn a_reader_of_the_channel_sleeps_when_there_is_no_new_sample() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let mut writer = bus.writer::<RateCommand>(&fast(), 1).unwrap();
        let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
        send(&mut writer, 0, 1);
        assert!(reader.advance().unwrap());
        reader.refresh();
        assert!(matches!(reader.latest_channel, LatestChannel::Open(_)));
        for tick in 1..20 {
            send(&mut writer, tick, 1);
            assert!(reader.advance().unwrap());
            assert!(matches!(reader.current, Current::InLane));
            let (until_ns, mut sleeps) = (monotonic_ns() + 2_000_000, 0);
            while monotonic_ns() < until_ns {
                reader.sleep(until_ns).unwrap();
                assert!(!reader.advance().unwrap());
                sleeps += 1;
            }
            assert!(sleeps <= 2, "tick {tick}: {sleeps} sleeps in 2 ms");
        }
    }

    /// The writer is interrupted between channel and queue: the queue holds a sample that the channel has delivered.
    #[test]
    fn a_sample_from_the_channel_is_not_repeated_when_a_late_sample_follows() {
        for sleeps in [false, true] {
            let domain = OwnedDomain::create(0).unwrap();
            let bus = bus(&domain);
            let mut writer = bus.writer::<RateCommand>(&fast(), 1).unwrap();
            let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
            send(&mut writer, 1, 1);
            reader.refresh();
            let mut received = Vec::new();
            let mut look = |reader: &mut IoxReader<RateCommand>| {
                reader.refresh();
                if sleeps {
                    reader.sleep(monotonic_ns()).unwrap();
                }
                while reader.advance().unwrap() {
                    received.push(reader.current().unwrap().stamp.tick);
                }
            };
            look(&mut reader);
            for tick in [5, 3, 6, 4, 7] {
                writer.fill(|sample| (sample.stamp.tick, sample.stamp.generation) = (tick, 1)).unwrap();
                writer.write_latest().unwrap();
                (0..3).for_each(|_| look(&mut reader));
                writer.publish().unwrap();
                (0..3).for_each(|_| look(&mut reader));
            }
            assert_eq!(received, [1, 5, 3, 6, 4, 7], "each once, with sleeps: {sleeps}");
        }
    }

    /// A reader that polls once per tick and never sleeps on the signal.
    #[test]
    fn a_successor_is_found_at_the_first_poll_after_a_refresh() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
        for generation in 1..4 {
            let mut writer = bus.writer::<RateCommand>(&fast(), generation).unwrap();
            send(&mut writer, generation, generation);
            reader.refresh();
            assert!(reader.advance().unwrap(), "generation {generation}");
            reader.refresh();
            send(&mut writer, 10 * generation, generation);
            assert!(reader.advance().unwrap() && matches!(reader.current, Current::InLane), "generation {generation}");
        }
    }

    /// A successor of the writer has its own channel, which the reader opens later.
    #[test]
    fn a_sample_only_in_the_queue_ends_the_sleep_and_is_read_next() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
        for generation in 1..4 {
            let mut writer = bus.writer::<RateCommand>(&fast(), generation).unwrap();
            for tick in 0..3 {
                let tick = 10 * generation + tick;
                send(&mut writer, tick, generation);
                reader.sleep(monotonic_ns() + 1_000_000).unwrap();
                assert!(reader.advance().unwrap(), "generation {generation}, tick {tick}");
                assert_eq!(key(reader.current().unwrap()), (generation, tick));
                assert!(!reader.advance().unwrap(), "once");
            }
            reader.refresh();
            assert!(!reader.advance().unwrap(), "the channel's sample was already read from the queue");
        }
    }
}
