//! Sends and receives messages between the hosts of a run; the only file that uses zenoh.
//!
//! The launching host is a router, all others are its clients: one port is open, and there is no multicast or gossip. Sending never
//! waits for the network: a message that cannot be sent is lost, an urgent one at once, any other when the queue is full. Must not
//! interpret messages, except time requests, which are answered where they arrive.

use super::endpoint::{Carrier, Endpoint, Keys};
use super::wire::{Message, Payload};
use crate::clock::{raw_ns, tai_offset_ns};
use serde_json::json;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};
use zenoh::Wait;
use zenoh::key_expr::KeyExpr;
use zenoh::pubsub::Subscriber;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Queryable;
use zenoh::{Config, Session};

/// Keys under which the launching host answers requests to join and for the time.
const JOIN: &str = "corotate/join";
const TIME: &str = "corotate/time";
/// Timeout of an answer, and over UDP, where only the next request replaces a lost datagram.
const ANSWER: Duration = Duration::from_secs(2);
const ANSWER_UDP: Duration = Duration::from_millis(700);
/// Number of requests in one session before a new session is opened.
const REQUESTS: usize = 3;
/// Timeout of the handshake of a connection, ms. Zenoh does not repeat a lost datagram of it.
const OPENING_MS: u64 = 1_500;
/// Timeout of the first handshake over UDP, ms. It doubles at every second attempt, up to [`OPENING_MS`].
const OPENING_UDP_MS: u64 = 400;
/// Silence after which zenoh closes a connection and connects again, ms. Longer over UDP, where no data queues up for a lost host and
/// connecting is difficult.
const LEASE_MS: u64 = 2_000;
const LEASE_UDP_MS: u64 = 10_000;
/// Queue length of messages that are not urgent, in batches of at most 64 KiB: the largest that zenoh allows.
const QUEUE_BATCHES: usize = 16;
/// Pause between two attempts to connect, ms.
const RETRY_MS: u64 = 200;
const RETRY: Duration = Duration::from_millis(RETRY_MS);

/// Returns the timeout of connecting to the launching host: longer where a handshake may be lost several times.
pub fn connect_timeout(endpoint: &Endpoint) -> Duration {
    Duration::from_secs(if endpoint.address.carrier == Carrier::Udp { 20 } else { 10 })
}

/// Failures of the connection between hosts.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum NetError {
    /// The address cannot be opened, to listen or to connect.
    #[error("cannot open {address}: {reason}; {remedy}")]
    #[strum(serialize = "cannot-connect")]
    Open {
        /// The address.
        address: String,
        /// Zenoh's reason.
        reason: String,
        /// The remedy.
        remedy: &'static str,
    },
    /// A key file cannot be read.
    #[error("cannot read {}: {reason}; docs/hosts.md shows how to make keys", path.display())]
    #[strum(serialize = "unreadable-key")]
    Key {
        /// The file.
        path: std::path::PathBuf,
        /// The system's reason.
        reason: String,
    },
    /// The host does not answer.
    #[error("no answer from {address}; check that `corotate run --listen` waits there")]
    #[strum(serialize = "host-silent")]
    Silent {
        /// The address.
        address: String,
    },
    /// Zenoh failed.
    #[error("cannot send a message: {0}; check the network")]
    #[strum(serialize = "network-failed")]
    Engine(String),
}

/// The direction of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Waits for connections: the launching host.
    Listen,
    /// Connects to the launching host.
    Connect,
}

fn config(endpoint: &Endpoint, side: Side, timeout: Duration, opening_ms: u64) -> Result<Config, NetError> {
    let mut config = Config::default();
    let mut set = |key: &str, value: serde_json::Value| {
        config.insert_json5(key, &value.to_string()).expect("the keys and values are valid in zenoh's configuration");
    };
    let (listen, connect) = match side {
        Side::Listen => (vec![endpoint.address.to_string()], Vec::new()),
        Side::Connect => (Vec::new(), vec![endpoint.address.to_string()]),
    };
    set("mode", json!(if side == Side::Listen { "router" } else { "client" }));
    set("listen/endpoints", json!(listen));
    set("connect/endpoints", json!(connect));
    set("connect/timeout_ms", json!(timeout.as_millis() as u64));
    set("connect/retry", json!({ "period_init_ms": RETRY_MS, "period_max_ms": RETRY_MS, "period_increase_factor": 1 }));
    set("scouting/multicast/enabled", json!(false));
    set("scouting/gossip/enabled", json!(false));
    set("timestamping/enabled", json!(false));
    set("adminspace/enabled", json!(false));
    set("transport/unicast/open_timeout", json!(opening_ms));
    set("transport/unicast/accept_timeout", json!(OPENING_MS));
    set(
        "transport/link/tx/lease",
        json!(if endpoint.address.carrier == Carrier::Udp { LEASE_UDP_MS } else { LEASE_MS }),
    );
    set("transport/link/tx/queue/size/data", json!(QUEUE_BATCHES));
    if let (Carrier::Quic, Some(Keys { ca, cert, key })) = (endpoint.address.carrier, &endpoint.keys) {
        [ca, cert, key].into_iter().try_for_each(|path| check_readable(path))?;
        set("transport/link/tls/root_ca_certificate", json!(ca));
        set("transport/link/tls/enable_mtls", json!(true));
        set("transport/link/tls/verify_name_on_connect", json!(true));
        for side in ["listen", "connect"] {
            set(&format!("transport/link/tls/{side}_certificate"), json!(cert));
            set(&format!("transport/link/tls/{side}_private_key"), json!(key));
        }
    }
    Ok(config)
}

fn check_readable(path: &Path) -> Result<(), NetError> {
    let failed = |error: std::io::Error| NetError::Key { path: path.to_owned(), reason: error.to_string() };
    std::fs::File::open(path).map(drop).map_err(failed)
}

/// Opens a session. Repeats attempts to connect until `timeout` is over.
fn open(endpoint: &Endpoint, side: Side, timeout: Duration) -> Result<Session, NetError> {
    if (side, endpoint.address.carrier) != (Side::Connect, Carrier::Udp) {
        return try_open(endpoint, side, timeout, OPENING_MS);
    }
    // Each attempt is a new session: the router refuses a second connection of a session whose handshake was lost halfway.
    let end = Instant::now() + timeout;
    for attempt in 0.. {
        let opening_ms = (OPENING_UDP_MS << (attempt / 2).min(8)).min(OPENING_MS);
        let opened = try_open(endpoint, side, Duration::from_millis(opening_ms), opening_ms);
        if !matches!(opened, Err(NetError::Open { .. })) || Instant::now() >= end {
            return opened;
        }
        std::thread::sleep(RETRY);
    }
    unreachable!("the loop returns at the timeout")
}

fn try_open(endpoint: &Endpoint, side: Side, timeout: Duration, opening_ms: u64) -> Result<Session, NetError> {
    zenoh::open(config(endpoint, side, timeout, opening_ms)?).wait().map_err(|error| NetError::Open {
        address: endpoint.address.to_string(),
        // Without zenoh's source location.
        reason: error.to_string().split(" at /").next().unwrap_or_default().to_owned(),
        remedy: match (side, endpoint.address.carrier) {
            (Side::Listen, _) => "choose a free address of this machine",
            (Side::Connect, Carrier::Quic) => {
                "check that `corotate run --listen` waits there, that one authority has signed the keys of both hosts, and that this address \
                 is in the launching host's certificate"
            }
            (Side::Connect, _) => "check that `corotate run --listen` waits there",
        },
    })
}

fn zenoh_failed(error: zenoh::Error) -> NetError {
    NetError::Engine(error.to_string())
}

/// A received message.
pub struct Arrival {
    /// When it arrived, on this host's monotonic clock, ns.
    pub at_ns: u64,
    /// The bytes.
    pub bytes: Vec<u8>,
}

/// The sending end of the connections to all hosts of a run.
pub struct Outbox {
    keys: Vec<KeyExpr<'static>>,
    session: RwLock<Option<Session>>,
}

impl Outbox {
    /// Sends a message to the host with number `to`. An `urgent` message is lost if it cannot be sent at once.
    ///
    /// # Errors
    /// [`NetError::Engine`].
    pub fn send(&self, to: u8, urgent: bool, message: &Message<'_>) -> Result<(), NetError> {
        let session = self.session.read().unwrap_or_else(PoisonError::into_inner);
        let Some(session) = &*session else { return Ok(()) };
        let priority = if urgent { Priority::RealTime } else { Priority::Data };
        // Not by a publisher: its declaration may be lost, and then it sends nothing. Sending never waits for room, because the
        // lossless stream repeats its frames.
        let put =
            session.put(&self.keys[usize::from(to)], message.encode()).congestion_control(CongestionControl::Drop);
        put.priority(priority).express(urgent).wait().map_err(zenoh_failed)
    }
}

/// A host's connection to the others of a run, until it is dropped.
pub struct Network {
    endpoint: Endpoint,
    /// This host's number.
    own: u8,
    on_message: Arc<dyn Fn(Arrival) + Send + Sync>,
    outbox: Arc<Outbox>,
    opened: Mutex<Option<Opened>>,
}

/// The parts of a session that end with it.
struct Opened {
    _subscriber: Subscriber<()>,
    _answers: Vec<Queryable<()>>,
}

/// A function that returns the answer to a request.
pub type Answers = Box<dyn Fn(&[u8]) -> Vec<u8> + Send + Sync>;

impl Network {
    /// Connects host number `own` of a run with `hosts` hosts. Calls `on_message` with each received message. On the launching host,
    /// `joins` answers requests to join.
    ///
    /// # Errors
    /// [`NetError`].
    pub fn open(
        endpoint: &Endpoint,
        run: &str,
        (own, hosts): (u8, u8),
        on_message: impl Fn(Arrival) + Send + Sync + 'static,
        joins: Option<Answers>,
    ) -> Result<Self, NetError> {
        let key = |host: u8| KeyExpr::try_from(format!("corotate/{run}/{host}")).map_err(zenoh_failed);
        let keys = (0..hosts).map(key).collect::<Result<_, NetError>>()?;
        let net = Self {
            endpoint: endpoint.clone(),
            own,
            on_message: Arc::new(on_message),
            outbox: Arc::new(Outbox { keys, session: RwLock::default() }),
            opened: Mutex::default(),
        };
        net.begin(joins, connect_timeout(endpoint))?;
        Ok(net)
    }

    /// Replaces the session with the launching host. Zenoh connects again by itself, but what it declares then may be lost: such a
    /// session looks open and carries nothing.
    ///
    /// # Errors
    /// [`NetError`]; the old session is kept.
    pub fn reopen(&self, timeout: Duration) -> Result<(), NetError> {
        self.begin(None, timeout)
    }

    fn begin(&self, joins: Option<Answers>, timeout: Duration) -> Result<(), NetError> {
        let side = if joins.is_some() { Side::Listen } else { Side::Connect };
        let session = open(&self.endpoint, side, timeout)?;
        let own = self.own;
        let old = self.outbox.session.write().unwrap_or_else(PoisonError::into_inner).replace(session.clone());
        let (hosts, outbox, on_message) = (self.outbox.keys.len(), self.outbox.clone(), self.on_message.clone());
        let on_sample = move |sample: zenoh::sample::Sample| {
            let (at_ns, bytes) = (raw_ns(), sample.payload().to_bytes().into_owned());
            if let Some(Message { from, payload: Payload::Ping { sent_ns } }) = Message::decode(&bytes)
                && usize::from(from) < hosts
            {
                // A request without an answer is repeated.
                let _ = outbox.send(from, true, &Message { from: own, payload: pong(sent_ns, at_ns) });
            }
            on_message(Arrival { at_ns, bytes });
        };
        let subscriber = session
            .declare_subscriber(&self.outbox.keys[usize::from(own)])
            .callback(on_sample)
            .wait()
            .map_err(zenoh_failed)?;
        let answers = joins.map_or(Ok(Vec::new()), |joins| {
            let time: Answers = Box::new(move |request| {
                let at_ns = raw_ns();
                let sent_ns = request.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
                Message { from: own, payload: pong(sent_ns, at_ns) }.encode()
            });
            [(JOIN, joins), (TIME, time)].map(|(key, answers)| answer(&session, key, answers)).into_iter().collect()
        })?;
        let opened = Opened { _subscriber: subscriber, _answers: answers };
        drop((self.opened.lock().unwrap_or_else(PoisonError::into_inner).replace(opened), old));
        Ok(())
    }

    /// Returns the sending end, which any thread may use.
    pub fn outbox(&self) -> Arc<Outbox> {
        self.outbox.clone()
    }
}

fn pong(sent_ns: u64, received_ns: u64) -> Payload<'static> {
    let tai_offset_ns = tai_offset_ns() as u64;
    Payload::Pong { sent_ns, received_ns, answered_ns: raw_ns(), tai_offset_ns }
}

fn answer(session: &Session, key: &'static str, answers: Answers) -> Result<Queryable<()>, NetError> {
    let callback = move |query: zenoh::query::Query| {
        let request = query.payload().map_or(Vec::new(), |payload| payload.to_bytes().into_owned());
        let _ = query.reply(key, answers(&request)).wait();
    };
    session.declare_queryable(key).callback(callback).wait().map_err(zenoh_failed)
}

/// Asks the launching host to join its run, until it answers or the timeout is over. A host that listens may not answer yet, and the
/// network may lose request, answer or handshake.
///
/// # Errors
/// [`NetError`].
pub fn ask_to_join(endpoint: &Endpoint, request: &[u8]) -> Result<Vec<u8>, NetError> {
    let end = Instant::now() + connect_timeout(endpoint);
    loop {
        let session = HubSession::open(endpoint, end.saturating_duration_since(Instant::now()))?;
        for _ in 0..REQUESTS {
            let asked = Instant::now();
            let answer = session.ask(JOIN, request);
            if !matches!(answer, Err(NetError::Silent { .. })) || Instant::now() >= end {
                return answer;
            }
            std::thread::sleep(RETRY.saturating_sub(asked.elapsed()));
        }
    }
}

/// A session with the launching host before a run.
pub struct HubSession {
    session: Session,
    address: String,
    timeout: Duration,
}

impl HubSession {
    /// Connects to the launching host.
    ///
    /// # Errors
    /// [`NetError`].
    pub fn open(endpoint: &Endpoint, timeout: Duration) -> Result<Self, NetError> {
        let answer_timeout = if endpoint.address.carrier == Carrier::Udp { ANSWER_UDP } else { ANSWER };
        Ok(Self {
            session: open(endpoint, Side::Connect, timeout)?,
            address: endpoint.address.to_string(),
            timeout: answer_timeout,
        })
    }

    /// Requests the time. Returns the answer, an encoded `Message`.
    ///
    /// # Errors
    /// [`NetError::Silent`], [`NetError::Engine`].
    pub fn request_time(&self) -> Result<Vec<u8>, NetError> {
        self.ask(TIME, &raw_ns().to_le_bytes())
    }

    fn ask(&self, key: &str, request: &[u8]) -> Result<Vec<u8>, NetError> {
        let silent = || NetError::Silent { address: self.address.clone() };
        let replies =
            self.session.get(key).payload(request.to_vec()).timeout(self.timeout).wait().map_err(zenoh_failed)?;
        let reply = replies.recv_timeout(self.timeout).ok().flatten().ok_or_else(silent)?;
        let sample = reply.result().map_err(|_| silent())?;
        Ok(sample.payload().to_bytes().into_owned())
    }
}
