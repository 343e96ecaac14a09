//! Both ends of a lossless stream over a lossy connection: numbered frames, repeated until they are acknowledged (go-back-N), with at
//! most [`WINDOW`] in flight.
//!
//! Pure: bytes in, bytes out, time is an argument. Must not interpret a frame.

use std::collections::VecDeque;

/// Largest number of frames in flight.
const WINDOW: usize = 256;
/// Timeout of an acknowledgement, as a multiple of the usual round trip.
const TIMEOUT_FACTOR: u64 = 4;
/// The shortest timeout, the one before any measurement, and the longest, ns.
const REPEAT_MIN_NS: u64 = 10_000_000;
const REPEAT_NS: u64 = 100_000_000;
const REPEAT_MAX_NS: u64 = 800_000_000;
/// Number of acknowledgements that lack the same frame after which it counts as lost.
const LACKING: u32 = 3;

/// The sending end.
#[derive(Debug)]
pub struct Sender {
    /// Number of the first frame in `frames`.
    first: u64,
    /// Unacknowledged frames.
    frames: VecDeque<Vec<u8>>,
    /// Number of these that are in flight.
    in_flight: usize,
    capacity: usize,
    /// Time of the last acknowledged or repeated frame, ns.
    progress_ns: u64,
    /// The current timeout, ns.
    timeout_ns: u64,
    /// Moving average of the round trip, ns.
    round_trip_ns: Option<u64>,
    /// The frame that measures the round trip, with the time at which it was sent.
    measured: Option<(u64, u64)>,
    /// Number of acknowledgements in a row that lack the first frame.
    lacking: u32,
    repeated: u64,
    refused: u64,
}

impl Sender {
    /// Creates an end that keeps at most `capacity` frames.
    pub fn new(capacity: usize) -> Self {
        Self {
            first: 0,
            frames: VecDeque::new(),
            in_flight: 0,
            capacity,
            progress_ns: 0,
            timeout_ns: REPEAT_NS,
            round_trip_ns: None,
            measured: None,
            lacking: 0,
            repeated: 0,
            refused: 0,
        }
    }

    /// Appends a frame. Returns false, and drops it, if `capacity` frames are unacknowledged.
    pub fn push(&mut self, frame: Vec<u8>) -> bool {
        let fits = self.frames.len() < self.capacity;
        if fits {
            self.frames.push_back(frame);
        } else {
            self.refused += 1;
        }
        fits
    }

    /// Calls `send` with each frame that is to be sent now, and its number.
    pub fn poll(&mut self, now_ns: u64, mut send: impl FnMut(u64, &[u8])) {
        if self.in_flight == 0 {
            self.progress_ns = now_ns;
        } else if now_ns.saturating_sub(self.progress_ns) >= self.timeout_ns {
            self.go_back(now_ns);
            self.timeout_ns = (2 * self.timeout_ns).min(REPEAT_MAX_NS);
        }
        if self.measured.is_none() && self.in_flight == 0 && !self.frames.is_empty() {
            self.measured = Some((self.first, now_ns));
        }
        while self.in_flight < self.frames.len().min(WINDOW) {
            send(self.first + self.in_flight as u64, &self.frames[self.in_flight]);
            self.in_flight += 1;
        }
    }

    /// Starts again at the first frame: the receiver drops all frames after a missing one.
    fn go_back(&mut self, now_ns: u64) {
        self.repeated += self.in_flight as u64;
        (self.in_flight, self.progress_ns, self.lacking) = (0, now_ns, 0);
        // An acknowledgement of a repeated frame does not tell which copy it is for, so it measures nothing.
        self.measured = Some((u64::MAX, 0));
    }

    /// Takes an acknowledgement of all frames before `next`.
    pub fn acknowledge(&mut self, next: u64, now_ns: u64) {
        if next == self.first && self.in_flight > 0 {
            self.lacking += 1;
            // Frames that were in flight before the last repetition are still being acknowledged.
            let long_enough = now_ns.saturating_sub(self.progress_ns) >= self.round_trip_ns.unwrap_or(REPEAT_NS);
            if self.lacking >= LACKING && long_enough {
                self.go_back(now_ns);
            }
        }
        let done = next.saturating_sub(self.first).min(self.frames.len() as u64) as usize;
        if done > 0 {
            self.frames.drain(..done);
            self.first += done as u64;
            self.in_flight = self.in_flight.saturating_sub(done);
            match self.measured {
                Some((number, sent_ns)) if number < next => {
                    let took_ns = now_ns.saturating_sub(sent_ns);
                    self.round_trip_ns =
                        Some(self.round_trip_ns.map_or(took_ns, |round_trip_ns| (7 * round_trip_ns + took_ns) / 8));
                    self.measured = None;
                }
                Some((u64::MAX, _)) => self.measured = None,
                _ => {}
            }
            let round_trip_ns = self.round_trip_ns.unwrap_or(REPEAT_NS / TIMEOUT_FACTOR);
            self.timeout_ns = (TIMEOUT_FACTOR * round_trip_ns).clamp(REPEAT_MIN_NS, REPEAT_MAX_NS);
            (self.progress_ns, self.lacking) = (now_ns, 0);
        }
    }

    /// Returns true once all frames have been acknowledged.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Returns the number of repeated frames.
    pub fn repeated(&self) -> u64 {
        self.repeated
    }

    /// Returns the number of dropped frames.
    pub fn refused(&self) -> u64 {
        self.refused
    }
}

/// The receiving end.
#[derive(Debug, Default)]
pub struct Receiver {
    next: u64,
    /// True while a received frame is not acknowledged.
    pending: bool,
}

impl Receiver {
    /// Takes the number of a received frame. Returns true if it is the next one, and to be used.
    pub fn take(&mut self, number: u64) -> bool {
        self.pending = true;
        let next = number == self.next;
        self.next += u64::from(next);
        next
    }

    /// Returns the acknowledgement to send, if frames have arrived since the last one.
    pub fn acknowledgement(&mut self) -> Option<u64> {
        std::mem::take(&mut self.pending).then_some(self.next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn all_frames_arrive_once_and_in_order_over_a_connection_that_loses_doubles_and_reorders(fate in prop::collection::vec(0_u8..10, 2000..4000), count in 1_usize..600) {
            let (mut sender, mut receiver) = (Sender::new(usize::MAX), Receiver::default());
            (0..count).for_each(|n| assert!(sender.push(n.to_le_bytes().to_vec())));
            let (mut fate, mut received, mut network) = (fate.into_iter().cycle(), Vec::new(), Vec::new());
            let mut now_ns = 0;
            while !sender.is_empty() {
                now_ns += 10_000_000;
                prop_assert!(now_ns < 3_600_000_000_000, "the stream does not finish");
                sender.poll(now_ns, |number, frame| network.push((number, frame.to_vec())));
                for (number, frame) in std::mem::take(&mut network) {
                    let copies = match fate.next() { Some(0) => 0, Some(1) => 2, Some(2) => { network.push((number, frame)); continue } _ => 1 };
                    for _ in 0..copies {
                        if receiver.take(number) {
                            received.push(usize::from_le_bytes(frame.clone().try_into().unwrap()));
                        }
                    }
                }
                if let Some(next) = receiver.acknowledgement().filter(|_| fate.next() != Some(0)) {
                    sender.acknowledge(next, now_ns);
                }
            }
            prop_assert_eq!(received, (0..count).collect::<Vec<_>>());
        }
    }

    #[test]
    fn frames_in_flight_and_unacknowledged_frames_are_bounded() {
        let mut sender = Sender::new(WINDOW + 5);
        let taken = (0..WINDOW + 7).filter(|_| sender.push(Vec::new())).count();
        assert_eq!((taken, sender.refused()), (WINDOW + 5, 2));
        let mut sent = Vec::new();
        sender.poll(0, |number, _| sent.push(number));
        sender.poll(1, |number, _| sent.push(number));
        assert_eq!(sent.len(), WINDOW);
        sender.acknowledge(3, 2);
        sender.acknowledge(2, 2);
        sender.poll(2, |number, _| sent.push(number));
        assert_eq!(sent.last(), Some(&(WINDOW as u64 + 2)));
        sender.poll(2 + REPEAT_NS, |number, _| sent.push(number));
        assert_eq!((sender.repeated(), sent[WINDOW + 3]), (WINDOW as u64, 3), "repeated from the first missing frame");
    }
}
