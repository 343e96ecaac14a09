//! A way that is worse than any cable: datagrams are delayed, lost, doubled, turned round, or cut off altogether.

use super::sites::Site;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What the way does. Parts are of a thousand.
#[derive(Clone, Copy, Default)]
pub struct Impairment {
    pub delay_us: u64,
    /// At most so much more, evenly.
    pub jitter_us: u64,
    pub lost: u64,
    pub doubled: u64,
    /// Held back by [`LATE`] more, so that others overtake it.
    pub late: u64,
}

const LATE: Duration = Duration::from_millis(3);

/// A proxy in front of a port of the first site, in the network of another.
pub struct Proxy {
    pub port: u16,
    stop: Arc<AtomicBool>,
    cut: Arc<AtomicBool>,
    /// Datagrams that it lost, doubled and held back.
    pub ill: Arc<[AtomicU64; 3]>,
    thread: Option<JoinHandle<()>>,
}

impl Proxy {
    /// Starts one at a site that passes on to an address, the same for each seed.
    pub fn start(site: &Site, to: SocketAddr, impairment: Impairment, seed: u64) -> Self {
        let (stop, cut) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let ill: Arc<[AtomicU64; 3]> = Arc::default();
        let (told, port) = std::sync::mpsc::channel();
        let way =
            Way { impairment, random: seed, cut: cut.clone(), ill: ill.clone(), queue: BinaryHeap::new(), number: 0 };
        let thread = std::thread::scope(|scope| {
            // A thread that has gone into another network stays there.
            let stop = stop.clone();
            let started = scope.spawn(move || {
                site.enter();
                let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
                told.send(socket.local_addr().unwrap().port()).unwrap();
                std::thread::spawn(move || carry(&socket, to, way, &stop))
            });
            started.join().unwrap()
        });
        Self { port: port.recv().unwrap(), stop, cut, ill, thread: Some(thread) }
    }

    /// Cuts the way off, or joins it again.
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

/// Datagrams on their way: when they are due, where to, by the order in which they came.
type Queue = BinaryHeap<Reverse<(Instant, u64, Option<SocketAddr>, SocketAddr, Vec<u8>)>>;

struct Way {
    impairment: Impairment,
    random: u64,
    cut: Arc<AtomicBool>,
    ill: Arc<[AtomicU64; 3]>,
    queue: Queue,
    number: u64,
}

impl Way {
    /// The next number of xorshift64*, below a bound.
    fn random(&mut self, below: u64) -> u64 {
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        (self.random.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) % below.max(1)
    }

    fn count(&self, kind: usize) {
        self.ill[kind].fetch_add(1, Ordering::Relaxed);
    }

    /// Takes a datagram in; `from` is the client that it comes from, or goes to.
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

/// Carries between clients and one server: a socket of its own for every client, by which the server knows it.
fn carry(socket: &UdpSocket, to: SocketAddr, mut way: Way, stop: &AtomicBool) {
    socket.set_nonblocking(true).unwrap();
    let mut clients: BTreeMap<SocketAddr, UdpSocket> = BTreeMap::new();
    let mut buffer = vec![0; 1 << 16];
    while !stop.load(Ordering::SeqCst) {
        let mut busy = false;
        while let Ok((length, client)) = socket.recv_from(&mut buffer) {
            way.take(None, client, &buffer[..length]);
            busy = true;
        }
        for (client, upstream) in &clients {
            while let Ok(length) = upstream.recv(&mut buffer) {
                way.take(Some(*client), to, &buffer[..length]);
                busy = true;
            }
        }
        let now = Instant::now();
        while way.queue.peek().is_some_and(|Reverse((due, ..))| *due <= now) {
            let Some(Reverse((_, _, back_to, from, bytes))) = way.queue.pop() else { break };
            // What cannot be sent is lost.
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
