//! A run live on a Foxglove WebSocket, from a process of its own: the channels of a recording, made by its tables.
//!
//! Messages are logged at the time when their tick was due, as `publish_time` is in a recording. Foxglove plots by that time,
//! and the time of receipt would be when this process looked: in steps of `LOOK_NS`.
//!
//! Must not be waited for by any role, nor take anything from a client. Who is slow, this process or a client, loses messages.

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

/// How much it gives way to everybody.
const NICENESS: i32 = 10;
/// Between two looks at the samples, ns.
const LOOK_NS: u64 = 5_000_000;
/// The run is over when nothing has come for so long after its stop, ns.
const QUIET_NS: u64 = 100_000_000;
/// Messages that may wait for one client; and they come to so many bytes at the most, where that is enough to go on.
const WAITING: std::ops::RangeInclusive<usize> = 64..=4096;
const WAITING_BYTES: usize = 16 << 20;

/// What to show, and where.
#[derive(Debug, Clone)]
pub struct FoxgloveSeat {
    /// The domain's directory, or that of the run's results; none is that of the newest run of this user.
    pub domain: Option<PathBuf>,
    /// Where to listen; at port 0 the system chooses one.
    pub address: SocketAddr,
    /// The file to tell the address in, instead of stderr.
    pub tell: Option<PathBuf>,
}

/// Why a run could not be shown.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum FoxgloveError {
    /// The run could not be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The run's seats for readers are taken.
    #[error("{source}; a run has room for few watchers, and of a fleet for one")]
    #[strum(serialize = "cannot-join")]
    Join {
        /// The signal, and why.
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
    /// The address cannot be had.
    #[error("cannot listen on {address}: {reason}; name another address, or port 0 for any that is free")]
    #[strum(serialize = "cannot-listen")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        reason: String,
    },
    /// The address could not be told.
    #[error("cannot write {}: {source}", path.display())]
    #[strum(serialize = "cannot-write")]
    Tell {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// Shows a run to its end, or until `terminated`.
///
/// # Errors
/// [`FoxgloveError`].
pub fn run_foxglove(seat: &FoxgloveSeat, terminated: &AtomicBool) -> Result<(), FoxgloveError> {
    let root = find_run(seat.domain.as_deref()).map_err(RoleError::from)?;
    let (domain, scenario) = join_complete(&root)?;
    let mut links = join_at_low_priority(&scenario, NICENESS, || Links::open(&domain, &scenario))
        .map_err(|source| FoxgloveError::Join { source })?;
    let ended = show(seat, &scenario, &domain, &mut links, terminated);
    with_realtime_priority(|| drop(links));
    domain.remove_if_over();
    ended
}

/// Every signal, and the launcher's word. The node goes last.
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

    fn hear(&mut self) -> Result<Schedule, BusError> {
        while self.schedule.advance()? {}
        Ok(self.schedule.current().copied().unwrap_or_default())
    }
}

fn show(
    seat: &FoxgloveSeat,
    scenario: &Scenario,
    domain: &Domain,
    links: &mut Links,
    terminated: &AtomicBool,
) -> Result<(), FoxgloveError> {
    let mut channels = Channels::default();
    links.taps.announce(&mut channels)?;
    // Its threads give way too: they have from this one what it has given up.
    let server = listen(seat.address, scenario, &channels)?;
    let url = format!("ws://{}", SocketAddr::new(seat.address.ip(), server.port()));
    match &seat.tell {
        Some(path) => {
            write_whole(path, url.as_bytes()).map_err(|source| FoxgloveError::Tell { path: path.clone(), source })?
        }
        None => crate::system::tell(format_args!("foxglove: {url}")),
    }
    let ended = follow(links, domain, &mut channels, terminated);
    // Not waited for: a client that does not read would never let it end.
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
    let waiting = (WAITING_BYTES / channels.longest.max(1)).clamp(*WAITING.start(), *WAITING.end());
    let server = WebSocketServer::new().name(format!("corotate {}", scenario.name)).bind(host, address.port());
    server.message_backlog_size(waiting).start_blocking().map_err(|error| {
        let reason = match error {
            foxglove::FoxgloveError::Bind(source) => source.to_string(),
            other => other.to_string(),
        };
        FoxgloveError::Listen { address, reason }
    })
}

/// Passes on what comes, from the first tick, or the one at hand, to the last.
fn follow(
    links: &mut Links,
    domain: &Domain,
    channels: &mut Channels,
    terminated: &AtomicBool,
) -> Result<(), FoxgloveError> {
    let mut came_ns = 0;
    while !terminated.load(Ordering::Relaxed) && domain.exists() {
        let (word, now_ns) = (links.hear()?, monotonic_ns());
        let phase = Phase::from_number(word.phase);
        if phase >= Phase::Run {
            links.taps.start(word.epoch_ns, Some(0));
            if links.taps.drain(channels)? > 0 {
                came_ns = now_ns;
            }
        }
        if phase == Phase::Stop && now_ns - came_ns > QUIET_NS {
            break;
        }
        sleep_until(now_ns + LOOK_NS);
    }
    Ok(())
}

/// The channels, by their numbers.
#[derive(Default)]
struct Channels {
    channels: Vec<Arc<RawChannel>>,
    /// The longest message, bytes.
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
        self.channels.push(channel.metadata(about).build_raw().expect("an encoding is all that a channel needs"));
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
