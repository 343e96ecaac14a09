//! Messages between the hosts of a run; the only file that knows zenoh.
//!
//! The host that launches is a router, every other one its client: one port is open, and nothing is looked for by multicast or gossip.
//! Nobody waits for a way: what finds none is lost, in a hurry at once, else after some bytes have piled up. Must not know what a message says, but for
//! questions for the time, which are answered where they arrive.

use super::seat::{Carrier, Endpoint, Keys};
use super::wire::{Message, What};
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

/// Where the host that launches answers whoever wants to join, or asks for the time.
const JOIN: &str = "corotate/join";
const TIME: &str = "corotate/time";
/// Time limit of one answer, and of one over UDP, where a lost datagram is only replaced by the next question.
const ANSWER: Duration = Duration::from_secs(2);
const ANSWER_UDP: Duration = Duration::from_millis(700);
/// Questions in one session before a new session is opened.
const QUESTIONS: usize = 3;
/// Time limit of the handshake of a connection, ms. The engine does not repeat a lost datagram of it.
const OPENING_MS: u64 = 1_500;
/// Time limit of the first handshake over UDP, ms. It doubles at every second attempt, up to [`OPENING_MS`].
const OPENING_UDP_MS: u64 = 400;
/// After so long without a word the engine gives a connection up and looks for another, ms; over UDP, where nothing piles up on the
/// way to a host that is gone, and a new connection is hard to get.
const LEASE_MS: u64 = 2_000;
const LEASE_UDP_MS: u64 = 10_000;
/// Batches, of 64 KiB at the most, that may pile up of what is in no hurry: the most that the engine allows.
const PILE: usize = 16;
/// Between two tries to connect again, ms.
const RETRY_MS: u64 = 200;
const RETRY: Duration = Duration::from_millis(RETRY_MS);

/// Returns how long the host that launches is looked for: longer where a handshake may be lost several times.
pub fn patience(endpoint: &Endpoint) -> Duration {
    Duration::from_secs(if endpoint.address.carrier == Carrier::Udp { 20 } else { 10 })
}

/// Why hosts cannot talk.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum NetError {
    /// Nobody can be reached, or nobody be listened for.
    #[error("{address}: {reason}; {remedy}")]
    #[strum(serialize = "cannot-connect")]
    Open {
        /// The address.
        address: String,
        /// The engine's reason.
        reason: String,
        /// What to do.
        remedy: &'static str,
    },
    /// A key file cannot be read.
    #[error("cannot read {}: {reason}; docs/hosts.md tells how to make keys", path.display())]
    #[strum(serialize = "unreadable-key")]
    Key {
        /// The file.
        path: std::path::PathBuf,
        /// The system's reason.
        reason: String,
    },
    /// There is somebody, but no answer.
    #[error("{address} does not answer; is `corotate run --listen` waiting there?")]
    #[strum(serialize = "host-silent")]
    Silent {
        /// The address.
        address: String,
    },
    /// The engine failed.
    #[error("a message cannot be sent: {0}; is the network down?")]
    #[strum(serialize = "network-failed")]
    Engine(String),
}

/// Which way a session goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// It waits for others: the host that launches.
    Listens,
    /// It goes to that one.
    Connects,
}

fn config(endpoint: &Endpoint, side: Side, patience: Duration, opening_ms: u64) -> Result<Config, NetError> {
    let mut config = Config::default();
    let mut set = |key: &str, value: serde_json::Value| {
        config.insert_json5(key, &value.to_string()).expect("these are keys of the engine's configuration");
    };
    let (listen, connect) = match side {
        Side::Listens => (vec![endpoint.address.to_string()], Vec::new()),
        Side::Connects => (Vec::new(), vec![endpoint.address.to_string()]),
    };
    set("mode", json!(if side == Side::Listens { "router" } else { "client" }));
    set("listen/endpoints", json!(listen));
    set("connect/endpoints", json!(connect));
    set("connect/timeout_ms", json!(patience.as_millis() as u64));
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
    set("transport/link/tx/queue/size/data", json!(PILE));
    if let (Carrier::Quic, Some(Keys { ca, cert, key })) = (endpoint.address.carrier, &endpoint.keys) {
        [ca, cert, key].into_iter().try_for_each(|path| readable(path))?;
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

fn readable(path: &Path) -> Result<(), NetError> {
    let failed = |error: std::io::Error| NetError::Key { path: path.to_owned(), reason: error.to_string() };
    std::fs::File::open(path).map(drop).map_err(failed)
}

/// Opens a session. One that connects is tried again until `patience` is over.
fn open(endpoint: &Endpoint, side: Side, patience: Duration) -> Result<Session, NetError> {
    if (side, endpoint.address.carrier) != (Side::Connects, Carrier::Udp) {
        return try_open(endpoint, side, patience, OPENING_MS);
    }
    // Each attempt is a session of its own: the router refuses a second connection of one whose handshake was half lost.
    let end = Instant::now() + patience;
    for attempt in 0.. {
        let opening_ms = (OPENING_UDP_MS << (attempt / 2).min(8)).min(OPENING_MS);
        let opened = try_open(endpoint, side, Duration::from_millis(opening_ms), opening_ms);
        if !matches!(opened, Err(NetError::Open { .. })) || Instant::now() >= end {
            return opened;
        }
        std::thread::sleep(RETRY);
    }
    unreachable!("the attempts end by the time")
}

fn try_open(endpoint: &Endpoint, side: Side, patience: Duration, opening_ms: u64) -> Result<Session, NetError> {
    zenoh::open(config(endpoint, side, patience, opening_ms)?).wait().map_err(|error| NetError::Open {
        address: endpoint.address.to_string(),
        // Where in the engine it was found out is of no use to anybody here.
        reason: error.to_string().split(" at /").next().unwrap_or_default().to_owned(),
        remedy: match (side, endpoint.address.carrier) {
            (Side::Listens, _) => "name an address of this machine that is free",
            (Side::Connects, Carrier::Quic) => {
                "is `corotate run --listen` waiting there, and has one authority signed the keys of both, with the host's name in its \
                 certificate?"
            }
            (Side::Connects, _) => "is `corotate run --listen` waiting there?",
        },
    })
}

fn engine(error: zenoh::Error) -> NetError {
    NetError::Engine(error.to_string())
}

/// A message that came, and when, on this host's monotonic clock, ns.
pub struct Arrived {
    /// When it came.
    pub at_ns: u64,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// The ways to all hosts of a run.
pub struct Post {
    keys: Vec<KeyExpr<'static>>,
    session: RwLock<Option<Session>>,
}

impl Post {
    /// Sends a message to the host of this number. One in a `hurry` is lost where there is no way for it at once.
    ///
    /// # Errors
    /// [`NetError::Engine`].
    pub fn send(&self, to: u8, hurry: bool, message: &Message<'_>) -> Result<(), NetError> {
        let session = self.session.read().unwrap_or_else(PoisonError::into_inner);
        let Some(session) = &*session else { return Ok(()) };
        let priority = if hurry { Priority::RealTime } else { Priority::Data };
        // Not by a publisher: what that declares, and is told in return, may be lost, and then nothing is sent. Even what must
        // not be lost is not waited for: it is sent again.
        let put =
            session.put(&self.keys[usize::from(to)], message.encode()).congestion_control(CongestionControl::Drop);
        put.priority(priority).express(hurry).wait().map_err(engine)
    }
}

/// A host's part in the messages of a run; it ends when this is dropped.
pub struct Net {
    endpoint: Endpoint,
    /// This host's number.
    own: u8,
    arrived: Arc<dyn Fn(Arrived) + Send + Sync>,
    post: Arc<Post>,
    opened: Mutex<Option<Opened>>,
}

/// The parts of a session that end with it.
struct Opened {
    _subscriber: Subscriber<()>,
    _answers: Vec<Queryable<()>>,
}

/// What answers questions: the request's bytes in, the answer's out.
pub type Answers = Box<dyn Fn(&[u8]) -> Vec<u8> + Send + Sync>;

impl Net {
    /// Opens the way to all `hosts` of a `run` for the one with number `own`. What comes goes to `arrived`; whoever wants to join is
    /// answered by `joins`, if this is where one joins.
    ///
    /// # Errors
    /// [`NetError`].
    pub fn open(
        endpoint: &Endpoint,
        run: &str,
        (own, hosts): (u8, u8),
        arrived: impl Fn(Arrived) + Send + Sync + 'static,
        joins: Option<Answers>,
    ) -> Result<Self, NetError> {
        let key = |host: u8| KeyExpr::try_from(format!("corotate/{run}/{host}")).map_err(engine);
        let keys = (0..hosts).map(key).collect::<Result<_, NetError>>()?;
        let net = Self {
            endpoint: endpoint.clone(),
            own,
            arrived: Arc::new(arrived),
            post: Arc::new(Post { keys, session: RwLock::default() }),
            opened: Mutex::default(),
        };
        net.begin(joins, patience(endpoint))?;
        Ok(net)
    }

    /// Replaces the session that goes to the host that launches. The engine connects again by itself, but what it declares then may
    /// be lost: such a session looks open and carries nothing.
    ///
    /// # Errors
    /// [`NetError`]; the old session is kept.
    pub fn reopen(&self, patience: Duration) -> Result<(), NetError> {
        self.begin(None, patience)
    }

    fn begin(&self, joins: Option<Answers>, patience: Duration) -> Result<(), NetError> {
        let side = if joins.is_some() { Side::Listens } else { Side::Connects };
        let session = open(&self.endpoint, side, patience)?;
        let own = self.own;
        let old = self.post.session.write().unwrap_or_else(PoisonError::into_inner).replace(session.clone());
        let (hosts, answers_to, arrived) = (self.post.keys.len(), self.post.clone(), self.arrived.clone());
        let heard = move |sample: zenoh::sample::Sample| {
            let (at_ns, bytes) = (raw_ns(), sample.payload().to_bytes().into_owned());
            if let Some(Message { from, what: What::Ping { sent_ns } }) = Message::decode(&bytes)
                && usize::from(from) < hosts
            {
                // A question that is not answered is asked again.
                let _ = answers_to.send(from, true, &Message { from: own, what: pong(sent_ns, at_ns) });
            }
            arrived(Arrived { at_ns, bytes });
        };
        let subscriber =
            session.declare_subscriber(&self.post.keys[usize::from(own)]).callback(heard).wait().map_err(engine)?;
        let answers = joins.map_or(Ok(Vec::new()), |joins| {
            let time: Answers = Box::new(move |request| {
                let at_ns = raw_ns();
                let sent_ns = request.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
                Message { from: own, what: pong(sent_ns, at_ns) }.encode()
            });
            [(JOIN, joins), (TIME, time)].map(|(key, answers)| answer(&session, key, answers)).into_iter().collect()
        })?;
        let opened = Opened { _subscriber: subscriber, _answers: answers };
        drop((self.opened.lock().unwrap_or_else(PoisonError::into_inner).replace(opened), old));
        Ok(())
    }

    /// The ways to all hosts, for any thread.
    pub fn post(&self) -> Arc<Post> {
        self.post.clone()
    }
}

fn pong(sent_ns: u64, received_ns: u64) -> What<'static> {
    let tai_offset_ns = tai_offset_ns() as u64;
    What::Pong { sent_ns, received_ns, answered_ns: raw_ns(), tai_offset_ns }
}

fn answer(session: &Session, key: &'static str, answers: Answers) -> Result<Queryable<()>, NetError> {
    let callback = move |query: zenoh::query::Query| {
        let request = query.payload().map_or(Vec::new(), |payload| payload.to_bytes().into_owned());
        let _ = query.reply(key, answers(&request)).wait();
    };
    session.declare_queryable(key).callback(callback).wait().map_err(engine)
}

/// Asks the host that launches to join its run, until it answers or the time is over. One that listens may not answer yet, and
/// a way that loses may lose the question, the answer, or the handshake.
///
/// # Errors
/// [`NetError`].
pub fn ask_to_join(endpoint: &Endpoint, request: &[u8]) -> Result<Vec<u8>, NetError> {
    let end = Instant::now() + patience(endpoint);
    loop {
        let inquiry = Inquiry::open(endpoint, end.saturating_duration_since(Instant::now()))?;
        for _ in 0..QUESTIONS {
            let asked = Instant::now();
            let answer = inquiry.ask(JOIN, request);
            if !matches!(answer, Err(NetError::Silent { .. })) || Instant::now() >= end {
                return answer;
            }
            std::thread::sleep(RETRY.saturating_sub(asked.elapsed()));
        }
    }
}

/// A way to ask the host that launches, before a run.
pub struct Inquiry {
    session: Session,
    address: String,
    limit: Duration,
}

impl Inquiry {
    /// Goes to where a run listens.
    ///
    /// # Errors
    /// [`NetError`].
    pub fn open(endpoint: &Endpoint, patience: Duration) -> Result<Self, NetError> {
        let limit = if endpoint.address.carrier == Carrier::Udp { ANSWER_UDP } else { ANSWER };
        Ok(Self { session: open(endpoint, Side::Connects, patience)?, address: endpoint.address.to_string(), limit })
    }

    /// Asks for the time; gives the answer, a message.
    ///
    /// # Errors
    /// [`NetError::Silent`], [`NetError::Engine`].
    pub fn time(&self) -> Result<Vec<u8>, NetError> {
        self.ask(TIME, &raw_ns().to_le_bytes())
    }

    fn ask(&self, key: &str, request: &[u8]) -> Result<Vec<u8>, NetError> {
        let silent = || NetError::Silent { address: self.address.clone() };
        let replies = self.session.get(key).payload(request.to_vec()).timeout(self.limit).wait().map_err(engine)?;
        let reply = replies.recv_timeout(self.limit).ok().flatten().ok_or_else(silent)?;
        let sample = reply.result().map_err(|_| silent())?;
        Ok(sample.payload().to_bytes().into_owned())
    }
}
