//! Both ends of a stream that loses nothing over a way that may: numbered frames, repeated until they are acknowledged, so many under
//! way at the most. Pure: bytes in, bytes out, time is an argument. Must not know what a frame holds.

use std::collections::VecDeque;

/// Frames under way at the most.
const WINDOW: usize = 256;
/// What is not acknowledged for so many times the usual is sent again, and never sooner, nor later, than so, ns.
const PATIENCE: u64 = 4;
const REPEAT_MIN_NS: u64 = 10_000_000;
const REPEAT_NS: u64 = 100_000_000;
const REPEAT_MAX_NS: u64 = 800_000_000;
/// So many acknowledgements that lack the same frame tell that it is lost.
const LACKING: u32 = 3;

/// The sending end.
#[derive(Debug)]
pub struct Sender {
    /// The number of the first frame that is kept.
    first: u64,
    frames: VecDeque<Vec<u8>>,
    /// How many of these are under way.
    under_way: usize,
    capacity: usize,
    progress_ns: u64,
    patience_ns: u64,
    /// How long an acknowledgement takes as a rule, ns; and a frame by which that is measured, with the time when it was sent.
    usual_ns: Option<u64>,
    measured: Option<(u64, u64)>,
    lacking: u32,
    repeated: u64,
    refused: u64,
}

impl Sender {
    /// An end that keeps so many frames at the most.
    pub fn new(capacity: usize) -> Self {
        Self {
            first: 0,
            frames: VecDeque::new(),
            under_way: 0,
            capacity,
            progress_ns: 0,
            patience_ns: REPEAT_NS,
            usual_ns: None,
            measured: None,
            lacking: 0,
            repeated: 0,
            refused: 0,
        }
    }

    /// Takes a frame; false, and it is lost, if too many wait already.
    pub fn push(&mut self, frame: Vec<u8>) -> bool {
        let fits = self.frames.len() < self.capacity;
        if fits {
            self.frames.push_back(frame);
        } else {
            self.refused += 1;
        }
        fits
    }

    /// Hands out what is to be sent now, with its number.
    pub fn poll(&mut self, now_ns: u64, mut send: impl FnMut(u64, &[u8])) {
        if self.under_way == 0 {
            self.progress_ns = now_ns;
        } else if now_ns.saturating_sub(self.progress_ns) >= self.patience_ns {
            self.go_back(now_ns);
            self.patience_ns = (2 * self.patience_ns).min(REPEAT_MAX_NS);
        }
        if self.measured.is_none() && self.under_way == 0 && !self.frames.is_empty() {
            self.measured = Some((self.first, now_ns));
        }
        while self.under_way < self.frames.len().min(WINDOW) {
            send(self.first + self.under_way as u64, &self.frames[self.under_way]);
            self.under_way += 1;
        }
    }

    /// Begins again with the first: whoever waits for it takes none of the others.
    fn go_back(&mut self, now_ns: u64) {
        self.repeated += self.under_way as u64;
        (self.under_way, self.progress_ns, self.lacking) = (0, now_ns, 0);
        // Of a frame that was sent twice nobody knows which one is acknowledged.
        self.measured = Some((u64::MAX, 0));
    }

    /// Takes an acknowledgement of all frames before `next`.
    pub fn acknowledged(&mut self, next: u64, now_ns: u64) {
        if next == self.first && self.under_way > 0 {
            self.lacking += 1;
            // What was under way when it was sent again is still being acknowledged.
            let long_enough = now_ns.saturating_sub(self.progress_ns) >= self.usual_ns.unwrap_or(REPEAT_NS);
            if self.lacking >= LACKING && long_enough {
                self.go_back(now_ns);
            }
        }
        let done = next.saturating_sub(self.first).min(self.frames.len() as u64) as usize;
        if done > 0 {
            self.frames.drain(..done);
            self.first += done as u64;
            self.under_way = self.under_way.saturating_sub(done);
            match self.measured {
                Some((number, sent_ns)) if number < next => {
                    let took_ns = now_ns.saturating_sub(sent_ns);
                    self.usual_ns = Some(self.usual_ns.map_or(took_ns, |usual_ns| (7 * usual_ns + took_ns) / 8));
                    self.measured = None;
                }
                Some((u64::MAX, _)) => self.measured = None,
                _ => {}
            }
            let usual_ns = self.usual_ns.unwrap_or(REPEAT_NS / PATIENCE);
            self.patience_ns = (PATIENCE * usual_ns).clamp(REPEAT_MIN_NS, REPEAT_MAX_NS);
            (self.progress_ns, self.lacking) = (now_ns, 0);
        }
    }

    /// Whether everything has been acknowledged.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Frames that were sent again.
    pub fn repeated(&self) -> u64 {
        self.repeated
    }

    /// Frames that found no room.
    pub fn refused(&self) -> u64 {
        self.refused
    }
}

/// The receiving end.
#[derive(Debug, Default)]
pub struct Receiver {
    next: u64,
    owes: bool,
}

impl Receiver {
    /// Takes the frame of a number; true if it is the next one, and to be used.
    pub fn take(&mut self, number: u64) -> bool {
        self.owes = true;
        let next = number == self.next;
        self.next += u64::from(next);
        next
    }

    /// The acknowledgement that is owed, if one is.
    pub fn acknowledgement(&mut self) -> Option<u64> {
        std::mem::take(&mut self.owes).then_some(self.next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Whatever the way loses, doubles or turns round, all frames come, in order, each once.
        #[test]
        fn nothing_is_lost_and_nothing_comes_twice(fate in prop::collection::vec(0_u8..10, 2000..4000), count in 1_usize..600) {
            let (mut sender, mut receiver) = (Sender::new(usize::MAX), Receiver::default());
            (0..count).for_each(|n| assert!(sender.push(n.to_le_bytes().to_vec())));
            let (mut fate, mut got, mut way) = (fate.into_iter().cycle(), Vec::new(), Vec::new());
            let mut now_ns = 0;
            while !sender.is_empty() {
                now_ns += 10_000_000;
                prop_assert!(now_ns < 3_600_000_000_000, "it comes to no end");
                sender.poll(now_ns, |number, frame| way.push((number, frame.to_vec())));
                for (number, frame) in std::mem::take(&mut way) {
                    let copies = match fate.next() { Some(0) => 0, Some(1) => 2, Some(2) => { way.push((number, frame)); continue } _ => 1 };
                    for _ in 0..copies {
                        if receiver.take(number) {
                            got.push(usize::from_le_bytes(frame.clone().try_into().unwrap()));
                        }
                    }
                }
                if let Some(next) = receiver.acknowledgement().filter(|_| fate.next() != Some(0)) {
                    sender.acknowledged(next, now_ns);
                }
            }
            prop_assert_eq!(got, (0..count).collect::<Vec<_>>());
        }
    }

    #[test]
    fn what_is_under_way_is_bounded_and_so_is_what_waits() {
        let mut sender = Sender::new(WINDOW + 5);
        let taken = (0..WINDOW + 7).filter(|_| sender.push(Vec::new())).count();
        assert_eq!((taken, sender.refused()), (WINDOW + 5, 2));
        let mut sent = Vec::new();
        sender.poll(0, |number, _| sent.push(number));
        sender.poll(1, |number, _| sent.push(number));
        assert_eq!(sent.len(), WINDOW);
        sender.acknowledged(3, 2);
        sender.acknowledged(2, 2);
        sender.poll(2, |number, _| sent.push(number));
        assert_eq!(sent.last(), Some(&(WINDOW as u64 + 2)));
        sender.poll(2 + REPEAT_NS, |number, _| sent.push(number));
        assert_eq!((sender.repeated(), sent[WINDOW + 3]), (WINDOW as u64, 3), "again, from the first that is lacked");
    }
}
