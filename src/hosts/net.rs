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
use std::sync::Arc;
use std::time::Duration;
use zenoh::Wait;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Queryable;
use zenoh::{Config, Session};

/// Where the host that launches answers whoever wants to join, or asks for the time.
const JOIN: &str = "corotate/join";
const TIME: &str = "corotate/time";
/// How long an answer may take.
const ANSWER: Duration = Duration::from_secs(2);
/// How long the first words of a connection may take, ms: what is lost of them is not sent again by itself.
const OPENING_MS: u64 = 1_500;
/// After so long without a word the engine gives a connection up and looks for another, ms.
const LEASE_MS: u64 = 2_000;
/// Batches, of 64 KiB at the most, that may pile up of what is in no hurry: the most that the engine allows.
const PILE: usize = 16;
/// Between two tries to connect again, ms.
const RETRY_MS: u64 = 200;

/// Why hosts cannot talk.
#[derive(Debug, thiserror::Error)]
pub enum NetError {
    /// Nobody can be reached, or nobody be listened for.
    #[error("{address}: {reason}; {remedy}")]
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
    Key {
        /// The file.
        path: std::path::PathBuf,
        /// The system's reason.
        reason: String,
    },
    /// There is somebody, but no answer.
    #[error("{address} does not answer; is `corotate run --listen` waiting there?")]
    Silent {
        /// The address.
        address: String,
    },
    /// The engine failed.
    #[error("a message cannot be sent: {0}; is the network down?")]
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

fn config(endpoint: &Endpoint, side: Side, patience: Duration) -> Result<Config, NetError> {
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
    set("transport/unicast/open_timeout", json!(OPENING_MS));
    set("transport/unicast/accept_timeout", json!(OPENING_MS));
    set("transport/link/tx/lease", json!(LEASE_MS));
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

fn open(endpoint: &Endpoint, side: Side, patience: Duration) -> Result<Session, NetError> {
    zenoh::open(config(endpoint, side, patience)?).wait().map_err(|error| NetError::Open {
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

/// The ways to one host.
struct Ways {
    hurried: Publisher<'static>,
    patient: Publisher<'static>,
}

/// The ways to all hosts of a run.
pub struct Post {
    ways: Vec<Ways>,
}

impl Post {
    /// Sends a message to the host of this number. One in a `hurry` is lost where there is no way for it at once.
    ///
    /// # Errors
    /// [`NetError::Engine`].
    pub fn send(&self, to: u8, hurry: bool, message: &Message<'_>) -> Result<(), NetError> {
        let ways = &self.ways[usize::from(to)];
        let way = if hurry { &ways.hurried } else { &ways.patient };
        way.put(message.encode()).wait().map_err(engine)
    }
}

/// A host's part in the messages of a run; it ends when this is dropped.
pub struct Net {
    post: Arc<Post>,
    _subscriber: Subscriber<()>,
    _answers: Vec<Queryable<()>>,
    _session: Session,
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
        patience: Duration,
    ) -> Result<Self, NetError> {
        let side = if joins.is_some() { Side::Listens } else { Side::Connects };
        let session = open(endpoint, side, patience)?;
        let key = |host: u8| format!("corotate/{run}/{host}");
        let way = |host: u8, hurry: bool| {
            let priority = if hurry { Priority::RealTime } else { Priority::Data };
            // Even what must not be lost is not waited for: it is sent again.
            let way = session.declare_publisher(key(host)).congestion_control(CongestionControl::Drop);
            way.priority(priority).express(hurry).wait().map_err(engine)
        };
        let ways = |host: u8| Ok(Ways { hurried: way(host, true)?, patient: way(host, false)? });
        let post = Arc::new(Post { ways: (0..hosts).map(ways).collect::<Result<_, NetError>>()? });
        let (answers_to, last) = (post.clone(), hosts);
        let heard = move |sample: zenoh::sample::Sample| {
            let (at_ns, bytes) = (raw_ns(), sample.payload().to_bytes().into_owned());
            match Message::decode(&bytes) {
                Some(Message { from, what: What::Ping { sent_ns } }) if from < last => {
                    let what = pong(sent_ns, at_ns);
                    // A question that is not answered is asked again.
                    let _ = answers_to.send(from, true, &Message { from: own, what });
                }
                _ => arrived(Arrived { at_ns, bytes }),
            }
        };
        let subscriber = session.declare_subscriber(key(own)).callback(heard).wait().map_err(engine)?;
        let answers = joins.map_or(Ok(Vec::new()), |joins| {
            let time: Answers = Box::new(move |request| {
                let at_ns = raw_ns();
                let sent_ns = request.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
                Message { from: own, what: pong(sent_ns, at_ns) }.encode()
            });
            [(JOIN, joins), (TIME, time)].map(|(key, answers)| answer(&session, key, answers)).into_iter().collect()
        })?;
        Ok(Self { post, _subscriber: subscriber, _answers: answers, _session: session })
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

/// A way to ask the host that launches, before a run.
pub struct Inquiry {
    session: Session,
    address: String,
}

impl Inquiry {
    /// Goes to where a run listens.
    ///
    /// # Errors
    /// [`NetError`].
    pub fn open(endpoint: &Endpoint, patience: Duration) -> Result<Self, NetError> {
        Ok(Self { session: open(endpoint, Side::Connects, patience)?, address: endpoint.address.to_string() })
    }

    /// Asks to join; gives the answer.
    ///
    /// # Errors
    /// [`NetError::Silent`], [`NetError::Engine`].
    pub fn join(&self, request: &[u8]) -> Result<Vec<u8>, NetError> {
        self.ask(JOIN, request)
    }

    /// Asks for the time; gives the answer, a message.
    ///
    /// # Errors
    /// As [`join`](Self::join).
    pub fn time(&self) -> Result<Vec<u8>, NetError> {
        self.ask(TIME, &raw_ns().to_le_bytes())
    }

    fn ask(&self, key: &str, request: &[u8]) -> Result<Vec<u8>, NetError> {
        let silent = || NetError::Silent { address: self.address.clone() };
        let replies = self.session.get(key).payload(request.to_vec()).timeout(ANSWER).wait().map_err(engine)?;
        let reply = replies.recv_timeout(ANSWER).ok().flatten().ok_or_else(silent)?;
        let sample = reply.result().map_err(|_| silent())?;
        Ok(sample.payload().to_bytes().into_owned())
    }
}
