//! Sends samples for which roles on other hosts wait: one thread per signal sleeps on its notifier and sends each sample at once.
//!
//! Must not wait for a receiver.

use super::endpoint::RELAY;
use super::net::Outbox;
use super::plan::Plan;
use super::wire::{Message, Payload};
use crate::bus::Port;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{BusError, Reader};
use crate::clock::monotonic_ns;
use crate::runtime::depths;
use crate::scenario::Scenario;
use crate::system::tell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

/// Longest sleep of a thread, ns.
const SLEEP_NS: u64 = 20_000_000;

/// The forwarding threads of a host.
pub struct Forwarders {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    /// Number of samples sent, by link and host.
    sent: Vec<(usize, u8, Arc<AtomicU64>)>,
}

/// The forwarder of one signal.
struct Forwarder {
    port: Port,
    link: u16,
    from: u8,
    to: Vec<(u8, Arc<AtomicU64>)>,
}

impl Forwarders {
    /// Starts a thread for each signal of this host for which a role on another host waits in real time.
    ///
    /// # Errors
    /// [`BusError::Domain`] if a thread cannot be started.
    pub fn start(domain: &Domain, scenario: &Scenario, plan: &Plan, outbox: &Arc<Outbox>) -> Result<Self, BusError> {
        let (stop, mut threads, mut sent) = (Arc::new(AtomicBool::new(false)), Vec::new(), Vec::new());
        for (number, link) in plan.links.iter().enumerate().filter(|(_, link)| link.from == plan.own) {
            let lossy = link.to.iter().filter(|destination| !destination.lossless);
            let to: Vec<_> = lossy.map(|destination| (destination.host, Arc::default())).collect();
            if to.is_empty() {
                continue;
            }
            sent.extend(to.iter().map(|(host, count)| (number, *host, Arc::clone(count))));
            let forwarder = Forwarder { port: link.port.clone(), link: number as u16, from: plan.own, to };
            let (domain, depths, outbox, stop) = (domain.clone(), depths(scenario), outbox.clone(), stop.clone());
            let forward = move || {
                let done =
                    IoxBus::enter(&domain, RELAY, depths).and_then(|bus| forwarder.forward(&bus, &outbox, &stop));
                if let Err(error) = done {
                    // The readers count the samples as missing.
                    tell(format_args!("corotate: the relay no longer sends {}: {error}", forwarder.port.topic));
                }
            };
            let started = std::thread::Builder::new().name("forward".to_owned()).spawn(forward);
            let failed =
                |error: std::io::Error| BusError::Domain { domain: RELAY.to_owned(), reason: error.to_string() };
            threads.push(started.map_err(failed)?);
        }
        Ok(Self { stop, threads, sent })
    }

    /// Returns the number of samples sent until now, by link and host.
    pub fn sent(&self) -> Vec<(usize, u8, u64)> {
        self.sent.iter().map(|(link, host, count)| (*link, *host, count.load(Ordering::Relaxed))).collect()
    }

    /// Ends all threads; returns the number of samples sent, by link and host.
    pub fn end(mut self) -> Vec<(usize, u8, u64)> {
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| {
            let _ = thread.join();
        });
        self.sent()
    }
}

impl Forwarder {
    fn forward(&self, bus: &IoxBus, outbox: &Outbox, stop: &AtomicBool) -> Result<(), BusError> {
        let mut reader = self.port.reader(bus, Reader::Scorer)?;
        while !stop.load(Ordering::Relaxed) {
            while let Some(words) = reader.next()? {
                for (host, count) in &self.to {
                    let number = count.fetch_add(1, Ordering::Relaxed);
                    let payload = Payload::Sample { link: self.link, number, sample: bytemuck::cast_slice(words) };
                    // A sample that cannot be sent counts as lost.
                    let _ = outbox.send(*host, true, &Message { from: self.from, payload });
                }
            }
            reader.sleep(monotonic_ns() + SLEEP_NS)?;
        }
        Ok(())
    }
}
