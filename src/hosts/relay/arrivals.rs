//! Messages of other hosts.

use super::super::net::Arrival;
use super::super::report::{far_end_path, relay_report_path};
use super::super::wire::{Content, Message, Payload};
use super::Relay;
use super::error::{RelayError, write};
use super::session::take_time;
use crate::bus::Write;
use crate::clock::{monotonic_ns, raw_ns};
use crate::config::ClockKind;
use crate::sample::{Health, Schedule, Stamp};
use crate::seat::report_path;
use std::path::PathBuf;

impl Relay<'_> {
    /// Takes a message of another host.
    pub(super) fn take(&mut self, arrival: &Arrival) -> Result<(), RelayError> {
        let hosts = self.plan.hosts.len() as u8;
        let known =
            Message::decode(&arrival.bytes).filter(|message| message.from < hosts && message.from != self.plan.own);
        let Some(Message { from, payload }) = known else {
            self.malformed += 1;
            return Ok(());
        };
        self.end_silence(from, arrival.at_ns);
        let from_hub = from == self.plan.hub;
        match payload {
            Payload::Sample { link, number, sample } => self.take_sample(from, link, Some(number), sample)?,
            Payload::Frame { number, content } => {
                if self.streams[usize::from(from)].1.take(number) {
                    self.take_content(from, content)?;
                }
            }
            Payload::Acknowledge { next } => self.streams[usize::from(from)].0.acknowledge(next, raw_ns()),
            Payload::Health { role, sample } => self.take_health(from, role, sample)?,
            Payload::Schedule { changes, sample } => match bytemuck::try_pod_read_unaligned::<Schedule>(sample) {
                Ok(schedule) if from_hub => {
                    // An older announcement may arrive after a newer one.
                    if schedule.stamp.tick > self.announced.1.stamp.tick {
                        self.announced = (changes, schedule);
                    }
                    self.adopt_schedule()?;
                }
                _ => self.malformed += 1,
            },
            Payload::Changes { first, changes: [] } => self.changes.requested(from, first),
            Payload::Changes { first, changes } if from_hub => {
                let next = self.changes.take(first, changes);
                self.send(from, true, Payload::Changes { first: next, changes: &[] });
                self.adopt_schedule()?;
            }
            Payload::Changes { .. } => self.malformed += 1,
            pong @ Payload::Pong { .. } => {
                if let Some(clock) = self.clock.as_mut().filter(|_| from_hub) {
                    self.session_monitor.answered_ns = arrival.at_ns;
                    take_time(clock, &pong, arrival.at_ns);
                }
            }
            // Answered in `net`, on arrival.
            Payload::Ping { .. } => {}
        }
        Ok(())
    }

    /// Passes the newest announcement on to the roles of a joined host, once they can see the changes of inputs that precede it.
    fn adopt_schedule(&mut self) -> Result<(), RelayError> {
        let (changes, schedule) = self.announced;
        let is_new = schedule.stamp.tick > self.schedule.stamp.tick && self.changes.count() >= changes;
        if let Some(out) = self.schedule_out.as_mut().filter(|_| is_new) {
            self.schedule = schedule;
            out.send(|sample| *sample = schedule)?;
        }
        Ok(())
    }

    /// Writes a sample of another host, unless it is malformed, repeated or late.
    fn take_sample(&mut self, from: u8, link: u16, number: Option<u64>, sample: &[u8]) -> Result<(), RelayError> {
        let plan = self.plan.links.get(usize::from(link));
        let fits = plan.filter(|plan| plan.from == from && plan.port.size == sample.len());
        let Some((_, incoming)) = fits.zip(self.incoming.get_mut(usize::from(link))) else {
            self.malformed += 1;
            return Ok(());
        };
        let Some(writer) = incoming.writer.as_mut().filter(|_| incoming.lossless == number.is_none()) else {
            self.malformed += 1;
            return Ok(());
        };
        if let Some(number) = number {
            if number < incoming.next {
                incoming.stale += 1;
                return Ok(());
            }
            incoming.lost += number - incoming.next;
            incoming.next = number + 1;
        }
        incoming.received += 1;
        let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
        if number.is_none() && !stamp.is_warm_up() {
            // A successor of the writer may repeat its predecessor's last sample.
            let is_repeated = |last: Stamp| {
                last.generation < stamp.generation && stamp == Stamp { generation: stamp.generation, ..last }
            };
            if incoming.last.replace(stamp).is_some_and(is_repeated) {
                return Ok(());
            }
            if let Some(retained) = &incoming.retained {
                let words = sample.chunks_exact(size_of::<u64>()).map(bytemuck::pod_read_unaligned);
                retained.keep(incoming.retained_count, words);
                incoming.retained_count += 1;
            }
        }
        writer.send(sample)?;
        if self.scenario.clock == ClockKind::Realtime && stamp.generation > 0 {
            incoming.one_way.record(stamp.sent_ns, monotonic_ns());
        }
        Ok(())
    }

    fn take_content(&mut self, from: u8, content: &[u8]) -> Result<(), RelayError> {
        match Content::decode(content) {
            Some(Content::Sample { link, sample }) => self.take_sample(from, link, None, sample),
            // Only the launching host keeps files, and only the final files of the others.
            Some(Content::File { name, bytes }) if self.plan.own == self.plan.hub && self.is_final_file(from, name) => {
                let path = self.domain.root().join(name);
                write(&path, bytes)?;
                if path == far_end_path(self.domain.root(), self.plan.name(from)) {
                    self.mark_ended(from);
                }
                Ok(())
            }
            _ => {
                self.malformed += 1;
                Ok(())
            }
        }
    }

    /// Returns true if a host sends a file of this name at its end.
    fn is_final_file(&self, from: u8, name: &str) -> bool {
        self.final_files(from).iter().any(|path| path.file_name().is_some_and(|file| file == name))
    }

    /// Returns the files that a host sends at its end; the last one completes them.
    pub(super) fn final_files(&self, from: u8) -> Vec<PathBuf> {
        let (root, host) = (self.domain.root(), self.plan.name(from));
        let roles = self.plan.roles.iter().filter(|(_, host)| *host == from);
        let reports = roles.map(|(role, _)| report_path(root, role.name(self.scenario)));
        reports.chain([relay_report_path(root, host), far_end_path(root, host)]).collect()
    }

    /// Notes that a host has ended: no further heartbeats of its roles are written.
    fn mark_ended(&mut self, from: u8) {
        self.ended[usize::from(from)] = true;
        let roles = self.plan.roles.iter().zip(&mut self.health_out);
        roles.filter(|((_, host), _)| *host == from).for_each(|(_, health)| *health = None);
    }

    fn take_health(&mut self, from: u8, role: u16, sample: &[u8]) -> Result<(), RelayError> {
        let role = usize::from(role);
        let theirs = self.plan.roles.get(role).is_some_and(|(_, host)| *host == from);
        match (self.health_out.get_mut(role), bytemuck::try_pod_read_unaligned::<Health>(sample)) {
            (Some(Some(out)), Ok(health)) if theirs => out.send(|sample| *sample = health)?,
            // A heartbeat may arrive after the host's final files.
            (Some(None), Ok(_)) if theirs => {}
            _ => self.malformed += 1,
        }
        Ok(())
    }
}
