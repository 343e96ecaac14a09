//! Publishes a run on a Foxglove WebSocket from a separate process, with the channels of a recording.
//!
//! The log time of a message is the due time of its tick, as `publish_time` is in a recording. Foxglove plots by log time;
//! times of receipt would come in steps of `POLL_NS`.
//!
//! Must not delay a role, nor accept input from a client. If this process or a client is slow, it loses messages.

use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal};
use crate::clock::{monotonic_ns, sleep_until};
use crate::record::{Channel, MessageSink, RecordError, Taps};
use crate::runtime::{depths, join_at_low_priority, topic, with_realtime_priority};
use crate::sample::{Layout, MESSAGE_ENCODING, Phase, SCHEMA_ENCODING, Schedule, frame, topic_of};
use crate::scenario::Scenario;
use crate::seat::{RoleError, find_run, join_complete, write_whole};
use foxglove::{ChannelBuilder, PartialMetadata, RawChannel, Schema, WebSocketServer, WebSocketServerHandle};
use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Niceness of this process: it yields to all others.
const NICENESS: i32 = 10;
/// Interval between polls, ns.
const POLL_NS: u64 = 5_000_000;
/// Silence after the stop that ends the run, ns.
const QUIET_NS: u64 = 100_000_000;
/// Least and largest number of messages queued for one client.
const BACKLOG: std::ops::RangeInclusive<usize> = 64..=4096;
/// Bytes queued for one client, unless `BACKLOG` requires more.
const BACKLOG_BYTES: usize = 16 << 20;

/// Source and address of a WebSocket.
#[derive(Debug, Clone)]
pub struct FoxgloveOptions {
    /// The directory of the domain or of the run's results; `None` selects the user's newest run.
    pub domain: Option<PathBuf>,
    /// The address to listen on; port 0 lets the system choose a port.
    pub address: SocketAddr,
    /// The file to write the URL to, instead of stderr.
    pub url_file: Option<PathBuf>,
}

/// A failure to publish a run.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum FoxgloveError {
    /// The run could not be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The run has too many readers.
    #[error("{source}; end another watcher: a run admits few, a fleet only one")]
    #[strum(serialize = "cannot-join")]
    Join {
        /// The signal and the reason.
        source: BusError,
    },
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A sample could not be taken.
    #[error(transparent)]
    #[strum(transparent)]
    Sample(#[from] RecordError),
    /// The address is not available.
    #[error("cannot listen on {address}: {reason}; name another address, or port 0 for any free port")]
    #[strum(serialize = "cannot-listen")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        reason: String,
    },
    /// The file for the URL could not be written.
    #[error("cannot write {}: {source}", path.display())]
    #[strum(serialize = "cannot-write")]
    UrlFile {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// Publishes a run to its end, or until `terminated`.
///
/// # Errors
/// [`FoxgloveError`].
pub fn run_foxglove(options: &FoxgloveOptions, terminated: &AtomicBool) -> Result<(), FoxgloveError> {
    let root = find_run(options.domain.as_deref()).map_err(RoleError::from)?;
    let (domain, scenario) = join_complete(&root)?;
    let mut links = join_at_low_priority(&scenario, NICENESS, || Links::open(&domain, &scenario))
        .map_err(|source| FoxgloveError::Join { source })?;
    let ended = publish(options, &scenario, &domain, &mut links, terminated);
    with_realtime_priority(|| drop(links));
    domain.remove_if_over();
    ended
}

/// Links to all signals and to the launcher. The bus must be dropped last.
struct Links {
    taps: Taps,
    schedule: <IoxBus as Bus>::Reader<Schedule>,
    _bus: IoxBus,
}

impl Links {
    fn open(domain: &Domain, scenario: &Scenario) -> Result<Self, BusError> {
        let bus = IoxBus::enter(domain, "foxglove", depths(scenario))?;
        let taps = Taps::open(scenario, &bus)?;
        let schedule = bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?;
        Ok(Self { taps, schedule, _bus: bus })
    }

    /// Returns the newest schedule; one of generation 0 if none has arrived.
    fn schedule(&mut self) -> Result<Schedule, BusError> {
        while self.schedule.advance()? {}
        Ok(self.schedule.current().copied().unwrap_or_default())
    }
}

/// Listens, reports the URL, and passes samples on.
fn publish(
    options: &FoxgloveOptions,
    scenario: &Scenario,
    domain: &Domain,
    links: &mut Links,
    terminated: &AtomicBool,
) -> Result<(), FoxgloveError> {
    let mut channels = Channels::default();
    links.taps.announce(&mut channels)?;
    // The server's threads inherit the low priority of this one.
    let server = listen(options.address, scenario, &channels)?;
    let url = format!("ws://{}", SocketAddr::new(options.address.ip(), server.port()));
    match &options.url_file {
        Some(path) => {
            write_whole(path, url.as_bytes()).map_err(|source| FoxgloveError::UrlFile { path: path.clone(), source })?
        }
        None => crate::system::tell(format_args!("foxglove: {url}")),
    }
    let ended = follow(links, domain, &mut channels, terminated);
    // Does not wait for the server: a client that does not read would block it forever.
    server.stop().detach_all();
    ended
}

fn listen(
    address: SocketAddr,
    scenario: &Scenario,
    channels: &Channels,
) -> Result<WebSocketServerHandle, FoxgloveError> {
    let host = match address.ip() {
        IpAddr::V4(ip) => ip.to_string(),
        IpAddr::V6(ip) => format!("[{ip}]"),
    };
    let backlog = (BACKLOG_BYTES / channels.longest.max(1)).clamp(*BACKLOG.start(), *BACKLOG.end());
    let server = WebSocketServer::new().name(format!("corotate {}", scenario.name)).bind(host, address.port());
    server.message_backlog_size(backlog).start_blocking().map_err(|error| {
        let reason = match error {
            foxglove::FoxgloveError::Bind(source) => source.to_string(),
            error => error.to_string(),
        };
        FoxgloveError::Listen { address, reason }
    })
}

/// Passes samples on from the first tick, or the current one, to the last.
fn follow(
    links: &mut Links,
    domain: &Domain,
    channels: &mut Channels,
    terminated: &AtomicBool,
) -> Result<(), FoxgloveError> {
    let mut last_sample_ns = 0;
    while !terminated.load(Ordering::Relaxed) && domain.exists() {
        let (schedule, now_ns) = (links.schedule()?, monotonic_ns());
        let phase = Phase::from_number(schedule.phase);
        if phase >= Phase::Run {
            links.taps.start(schedule.epoch_ns, Some(0));
            if links.taps.drain(channels)? > 0 {
                last_sample_ns = now_ns;
            }
        }
        if phase == Phase::Stop && now_ns - last_sample_ns > QUIET_NS {
            break;
        }
        sleep_until(now_ns + POLL_NS);
    }
    Ok(())
}

/// The channels in the order of their numbers.
#[derive(Default)]
struct Channels {
    channels: Vec<Arc<RawChannel>>,
    /// Length of the longest sample, bytes.
    longest: usize,
    message: Vec<u8>,
}

impl MessageSink for Channels {
    fn channel(
        &mut self,
        service: &str,
        layout: &Layout,
        about: BTreeMap<String, String>,
    ) -> Result<Channel, RecordError> {
        let schema = Schema::new(layout.message_name(), SCHEMA_ENCODING, layout.definition().into_bytes());
        let channel = ChannelBuilder::new(topic_of(service)).schema(schema).message_encoding(MESSAGE_ENCODING);
        self.channels.push(channel.metadata(about).build_raw().expect("a channel with an encoding is valid"));
        self.longest = self.longest.max(layout.size());
        Ok((self.channels.len() - 1) as Channel)
    }

    fn message(
        &mut self,
        channel: Channel,
        _sequence: u32,
        due_ns: u64,
        _logged_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError> {
        let channel = &self.channels[usize::from(channel)];
        if channel.has_sinks() {
            frame(body, &mut self.message);
            channel.log_with_meta(&self.message, PartialMetadata::with_log_time(due_ns));
        }
        Ok(())
    }
}
