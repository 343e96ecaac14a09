//! A proxy that impairs a UDP connection: it delays, loses, doubles and reorders datagrams, or drops all of them.

use super::sites::Site;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::net::{SocketAddr, UdpSocket};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Impairments of a connection; shares are in parts per thousand.
#[derive(Clone, Copy, Default)]
pub struct Impairment {
    pub delay_us: u64,
    /// Upper bound of an additional, uniformly distributed delay.
    pub jitter_us: u64,
    /// Share of lost datagrams.
    pub lost: u64,
    /// Share of doubled datagrams.
    pub doubled: u64,
    /// Share of datagrams delayed by a further [`LATE`], so that later ones overtake them.
    pub late: u64,
}

const LATE: Duration = Duration::from_millis(3);

/// A proxy in the network of one site, before a port of the first site.
pub struct Proxy {
    pub port: u16,
    stop: Arc<AtomicBool>,
    cut: Arc<AtomicBool>,
    /// Number of lost, doubled and late datagrams.
    pub impaired: Arc<[AtomicU64; 3]>,
    thread: Option<JoinHandle<()>>,
}

impl Proxy {
    /// Starts a proxy at a site that forwards to `to`. Equal seeds give equal impairments.
    pub fn start(site: &Site, to: SocketAddr, impairment: Impairment, seed: u64) -> Self {
        let (stop, cut) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let impaired: Arc<[AtomicU64; 3]> = Arc::default();
        let (port_sender, port) = std::sync::mpsc::channel();
        let connection = Connection {
            impairment,
            random: seed,
            cut: cut.clone(),
            impaired: impaired.clone(),
            queue: BinaryHeap::new(),
            number: 0,
        };
        let thread = std::thread::scope(|scope| {
            // A thread that has entered another network namespace stays there, so a helper thread enters it.
            let stop = stop.clone();
            let started = scope.spawn(move || {
                site.enter();
                let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
                port_sender.send(socket.local_addr().unwrap().port()).unwrap();
                std::thread::spawn(move || {
                    // A network does not wait for other tests. Only root has the privilege.
                    let tid = rustix::thread::gettid().as_raw_nonzero().to_string();
                    let _ = Command::new("chrt").args(["-f", "-p", "50", &tid]).output();
                    forward(&socket, to, connection, &stop)
                })
            });
            started.join().unwrap()
        });
        Self { port: port.recv().unwrap(), stop, cut, impaired, thread: Some(thread) }
    }

    /// Interrupts the connection, or restores it.
    pub fn cut(&self, cut: bool) {
        self.cut.store(cut, Ordering::SeqCst);
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        let _ = self.thread.take().unwrap().join();
    }
}

/// Datagrams in flight: due time, number by arrival, client to which it returns (`None` towards the server), peer, bytes.
type Queue = BinaryHeap<Reverse<(Instant, u64, Option<SocketAddr>, SocketAddr, Vec<u8>)>>;

struct Connection {
    impairment: Impairment,
    random: u64,
    cut: Arc<AtomicBool>,
    impaired: Arc<[AtomicU64; 3]>,
    queue: Queue,
    number: u64,
}

impl Connection {
    /// Returns the next number of xorshift64*, below a bound.
    fn random(&mut self, below: u64) -> u64 {
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        (self.random.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) % below.max(1)
    }

    fn count(&self, kind: usize) {
        self.impaired[kind].fetch_add(1, Ordering::Relaxed);
    }

    /// Takes a datagram. Towards the server, `back_to` is `None` and `from` the client; towards a client, `back_to` is that client.
    fn take(&mut self, back_to: Option<SocketAddr>, from: SocketAddr, bytes: &[u8]) {
        let Impairment { delay_us, jitter_us, lost, doubled, late } = self.impairment;
        if self.cut.load(Ordering::SeqCst) || self.random(1000) < lost {
            self.count(0);
            return;
        }
        let copies = if self.random(1000) < doubled { 2 } else { 1 };
        for copy in 0..copies {
            let mut due = Instant::now() + Duration::from_micros(delay_us + self.random(jitter_us + 1));
            if self.random(1000) < late {
                due += LATE;
                self.count(2);
            }
            if copy > 0 {
                self.count(1);
            }
            self.number += 1;
            self.queue.push(Reverse((due, self.number, back_to, from, bytes.to_vec())));
        }
    }
}

/// Forwards between clients and one server, with a socket per client, by which the server distinguishes them.
fn forward(socket: &UdpSocket, to: SocketAddr, mut connection: Connection, stop: &AtomicBool) {
    socket.set_nonblocking(true).unwrap();
    let mut clients: BTreeMap<SocketAddr, UdpSocket> = BTreeMap::new();
    let mut buffer = vec![0; 1 << 16];
    while !stop.load(Ordering::SeqCst) {
        let mut busy = false;
        while let Ok((length, client)) = socket.recv_from(&mut buffer) {
            connection.take(None, client, &buffer[..length]);
            busy = true;
        }
        for (client, upstream) in &clients {
            while let Ok(length) = upstream.recv(&mut buffer) {
                connection.take(Some(*client), to, &buffer[..length]);
                busy = true;
            }
        }
        let now = Instant::now();
        while connection.queue.peek().is_some_and(|Reverse((due, ..))| *due <= now) {
            let Some(Reverse((_, _, back_to, from, bytes))) = connection.queue.pop() else { break };
            // A datagram that cannot be sent is lost.
            let _ = match back_to {
                Some(client) => socket.send_to(&bytes, client),
                None => clients.entry(from).or_insert_with(|| upstream(to)).send(&bytes),
            };
        }
        if !busy {
            std::thread::sleep(Duration::from_micros(100));
        }
    }
}

fn upstream(to: SocketAddr) -> UdpSocket {
    let any = if to.ip().is_loopback() { "127.0.0.1:0" } else { "0.0.0.0:0" };
    let socket = UdpSocket::bind(any).unwrap();
    socket.connect(to).unwrap();
    socket.set_nonblocking(true).unwrap();
    socket
}
