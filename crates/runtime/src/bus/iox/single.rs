//! The links of single bodies over shared memory: samples of one size, by a queue, and the newest by its lane too.

use super::cause;
use super::latest::{LatestReader, LatestWriter};
use super::service::{Ipc, Wire, has_writer, writer};
use crate::bus::notifier::Notifier;
use crate::bus::{BusError, Read, Topic, Write, WriterProcess};
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
    /// What was shown in the lane and is not sent.
    pub(super) unpublished: Option<SampleMut<Ipc, Wire<S>, ()>>,
    pub(super) notifier: Notifier,
    pub(super) topic: Topic,
}

impl<S: Sample> IoxWriter<S> {
    /// The sample that was filled, and is in the lane if there is one.
    #[inline]
    fn filled(&mut self) -> Option<SampleMut<Ipc, Wire<S>, ()>> {
        let sample = self.loan.take()?;
        if let Some(latest) = &self.latest {
            latest.put(&sample.payload().0);
            // Whoever looks at the lane need not sleep until the queues are served.
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

    /// Takes the next sample's memory: iceoryx2's one small allocation per sample happens here, off the critical path.
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

/// Looks at the fast lane between two at the queue, where nothing new is as a rule.
const LOOKS: u32 = 256;

/// The reading end.
pub struct IoxReader<S: Sample> {
    pub(super) node: Rc<Node<Ipc>>,
    pub(super) service: PortFactory<Ipc, Wire<S>, ()>,
    pub(super) subscriber: Subscriber<Ipc, Wire<S>, ()>,
    pub(super) latest_channel: LatestChannel<S>,
    /// Looks at the lane that found nothing.
    pub(super) idle: u32,
    pub(super) current: Current<S>,
    /// Generation and tick of the last two samples that the lane has had, the newer first.
    pub(super) channel_keys: [(u64, u64); 2],
    /// Taken from the queue before a sleep, and not told of yet.
    pub(super) pending: Option<Received<Ipc, Wire<S>, ()>>,
    /// Generation and tick of the last sample told of.
    pub(super) newest: (u64, u64),
    pub(super) notifier: Notifier,
    pub(super) topic: Topic,
}

/// A reader's fast lane.
#[allow(clippy::large_enum_variant, reason = "there is one per reader, and it is looked at at every tick")]
pub(super) enum LatestChannel<S: Sample> {
    /// There is none.
    None,
    /// It is to be looked for: that of a writer of this generation.
    Wanted { generation: u64 },
    /// It is there.
    Open(LatestReader<S>),
}

/// What tells the samples of a signal apart, and orders them: generation and tick.
#[inline]
fn key(sample: &impl Sample) -> (u64, u64) {
    let stamp = sample.stamp();
    (stamp.generation & !NO_SAMPLE, stamp.tick)
}

/// No sample has this key.
pub(super) const NO_KEY: (u64, u64) = (u64::MAX, u64::MAX);

/// Returns true if a sample of this key in the queue is not news to a reader to which the lane has `shown` two.
///
/// A writer serves the lane before the queue, so the queue may still hold the sample before the one in the lane. Keys do not
/// tell the order of the two: the one in the lane may be late by a scripted fault.
#[inline]
fn is_overtaken<S: Sample>(channel: &LatestChannel<S>, channel_keys: &[(u64, u64); 2], key: (u64, u64)) -> bool {
    channel_keys.contains(&key) || matches!(channel, LatestChannel::Open(latest) if key <= self::key(latest.sample()))
}

/// Where the sample at hand is.
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

    /// Takes the next sample from the queue that the lane has not had.
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
            // Warm-up tells nothing of its writer.
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
                // The queue may have been faster, and the lane may take one sample for two.
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
            // What the lane has had waits in the queue too. It is no news, and is taken out, or no sleep would last.
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
            // The next look goes to the queue, if nothing is in the lane.
            *idle = u32::MAX;
            Ok(true)
        })
    }

    fn refresh(&mut self) {
        // Or the first look at the queue, once the lane is open, would connect to its writer in the midst of the loop. What
        // is wrong with it is told by that look.
        let _ = self.subscriber.update_connections();
        // Whoever looks once per tick would find a new writer of the signal only after so many ticks.
        self.idle = u32::MAX;
        if let LatestChannel::Wanted { generation } = self.latest_channel {
            match LatestReader::open(&self.node, &self.topic, generation) {
                Some(latest) => self.latest_channel = LatestChannel::Open(latest),
                // Where there is none there will be none: a lane is made before its signal. But before the first sample it
                // is not known whose to look for.
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

    /// A signal with a fast lane, whose bus has links of the newest sample.
    fn fast() -> Topic {
        Topic { signal: Signal::Command, ..topic() }
    }

    fn send(writer: &mut IoxWriter<RateCommand>, tick: u64, generation: u64) {
        writer.send(|sample| (sample.stamp.tick, sample.stamp.generation) = (tick, generation)).unwrap();
    }

    /// The queue still holds what the lane has given: that must not keep the reader awake.
    #[test]
    fn a_reader_of_the_lane_sleeps_at_once_when_there_is_nothing_new() {
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

    /// A writer that is interrupted between the lane and the queue: the queue holds what the lane has shown before.
    #[test]
    fn what_the_lane_has_shown_is_not_told_again_when_a_late_sample_follows() {
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

    /// A reader that looks once per tick, and never sleeps on the signal.
    #[test]
    fn a_successor_is_found_at_the_first_look_after_a_refresh() {
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

    /// A successor of the writer has a lane of its own, which is looked for only later.
    #[test]
    fn what_only_the_queue_has_ends_the_sleep_and_is_found_at_the_next_look() {
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
            assert!(!reader.advance().unwrap(), "what is in the channel now was in the queue");
        }
    }
}
