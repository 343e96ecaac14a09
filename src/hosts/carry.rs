//! Carries samples that roles elsewhere wait for: a thread per signal sleeps on its notifier and sends what comes at once.
//!
//! Must not wait for anybody who receives.

use super::net::Post;
use super::plan::Plan;
use super::seat::RELAY;
use super::wire::{Message, What};
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

/// How long a thread sleeps at the most, ns.
const SLEEP_NS: u64 = 20_000_000;

/// The threads of a host that carry.
pub struct Carriers {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    /// By link and host, how many samples were sent.
    sent: Vec<(usize, u8, Arc<AtomicU64>)>,
}

/// What one thread carries.
struct Load {
    port: Port,
    link: u16,
    from: u8,
    to: Vec<(u8, Arc<AtomicU64>)>,
}

impl Carriers {
    /// Starts one for each signal of this host that somebody elsewhere waits for in real time.
    ///
    /// # Errors
    /// [`BusError::Domain`] if the system gives no thread.
    pub fn start(domain: &Domain, scenario: &Scenario, plan: &Plan, post: &Arc<Post>) -> Result<Self, BusError> {
        let (stop, mut threads, mut sent) = (Arc::new(AtomicBool::new(false)), Vec::new(), Vec::new());
        for (link, of) in plan.links.iter().enumerate().filter(|(_, link)| link.from == plan.own) {
            let to: Vec<_> = of.to.iter().filter(|way| !way.lossless).map(|way| (way.host, Arc::default())).collect();
            if to.is_empty() {
                continue;
            }
            sent.extend(to.iter().map(|(host, count)| (link, *host, Arc::clone(count))));
            let load = Load { port: of.port.clone(), link: link as u16, from: plan.own, to };
            let (domain, depths, post, stop) = (domain.clone(), depths(scenario), post.clone(), stop.clone());
            let carry = move || {
                let carried = IoxBus::enter(&domain, RELAY, depths).and_then(|bus| load.carry(&bus, &post, &stop));
                if let Err(error) = carried {
                    // Whoever waits for the samples counts them as missing.
                    tell(format_args!("corotate: the relay carries {} no more: {error}", load.port.topic));
                }
            };
            let started = std::thread::Builder::new().name("carry".to_owned()).spawn(carry);
            let failed =
                |error: std::io::Error| BusError::Domain { domain: RELAY.to_owned(), reason: error.to_string() };
            threads.push(started.map_err(failed)?);
        }
        Ok(Self { stop, threads, sent })
    }

    /// What was sent so far, by link and host.
    pub fn sent(&self) -> Vec<(usize, u8, u64)> {
        self.sent.iter().map(|(link, host, count)| (*link, *host, count.load(Ordering::Relaxed))).collect()
    }

    /// Ends all; what was sent, by link and host.
    pub fn end(mut self) -> Vec<(usize, u8, u64)> {
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| {
            let _ = thread.join();
        });
        self.sent()
    }
}

impl Load {
    fn carry(&self, bus: &IoxBus, post: &Post, stop: &AtomicBool) -> Result<(), BusError> {
        let mut reader = self.port.reader(bus, Reader::Scorer)?;
        while !stop.load(Ordering::Relaxed) {
            while let Some(words) = reader.next()? {
                for (host, count) in &self.to {
                    let number = count.fetch_add(1, Ordering::Relaxed);
                    let what = What::Sample { link: self.link, number, sample: bytemuck::cast_slice(words) };
                    // Where there is no way, it is lost on it.
                    let _ = post.send(*host, true, &Message { from: self.from, what });
                }
            }
            reader.sleep(monotonic_ns() + SLEEP_NS)?;
        }
        Ok(())
    }
}
