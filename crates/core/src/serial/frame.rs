//! Frames: a payload with its CRC, COBS-encoded between two zero bytes, and the decoder that finds them in a byte
//! stream.
//!
//! Pure and of bounded memory. This module must not depend on a payload's meaning, and must not panic on any input:
//! it counts and drops everything that is not a frame.

use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Deserialize, Serialize};

/// The maximum length of a payload, bytes.
pub const MAX_PAYLOAD: usize = 1020;
/// The maximum length of a frame with its delimiters, bytes.
pub const MAX_FRAME: usize = MAX_BLOCK + 2;
/// CRC-32 as in zlib, Ethernet and PNG: reflected polynomial 0x04C11DB7, initial value and final XOR 0xFFFFFFFF.
pub const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

const CRC_BYTES: usize = 4;
const MAX_CHECKED: usize = MAX_PAYLOAD + CRC_BYTES;
/// COBS adds one byte, and one more for every 254 bytes without a zero.
const MAX_BLOCK: usize = cobs::max_encoding_length(MAX_CHECKED);
const DELIMITER: u8 = 0;

const _: () = assert!(MAX_CHECKED == 1024 && MAX_FRAME == 1031);

/// The payload is longer than [`MAX_PAYLOAD`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a message is longer than the {MAX_PAYLOAD} bytes that a frame holds; shorten the names in it")]
pub struct TooLong;

/// Writes the frame of a payload and returns it. It begins with a delimiter too, so that preceding garbage on the
/// line does not become part of it.
///
/// # Errors
/// [`TooLong`] if the payload is too long.
pub fn encode<'a>(payload: &[u8], frame: &'a mut [u8; MAX_FRAME]) -> Result<&'a [u8], TooLong> {
    let length = payload.len();
    if length > MAX_PAYLOAD {
        return Err(TooLong);
    }
    let mut checked = [0; MAX_CHECKED];
    checked[..length].copy_from_slice(payload);
    checked[length..length + CRC_BYTES].copy_from_slice(&CRC.checksum(payload).to_le_bytes());
    frame[0] = DELIMITER;
    let block = cobs::encode(&checked[..length + CRC_BYTES], &mut frame[1..]);
    frame[1 + block] = DELIMITER;
    Ok(&frame[..block + 2])
}

/// The counters of a decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct FrameCounters {
    /// Bytes received.
    pub bytes: u64,
    /// Frames found.
    pub frames: u64,
    /// Blocks between delimiters that were valid COBS with a wrong CRC.
    pub crc_errors: u64,
    /// Blocks between delimiters that were too short, too long, or invalid COBS.
    pub malformed: u64,
    /// Bytes of those blocks.
    pub dropped_bytes: u64,
    /// Valid frames after a dropped block.
    pub resyncs: u64,
}

/// A decoder that finds frames in a byte stream.
#[derive(Debug, Clone)]
pub struct Decoder {
    block: [u8; MAX_BLOCK],
    length: usize,
    /// The bytes of the current block beyond the maximum length of a frame.
    excess: u64,
    /// True if a block was dropped since the last valid frame.
    lost: bool,
    counters: FrameCounters,
}

enum Fault {
    Crc,
    Form,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { block: [0; MAX_BLOCK], length: 0, excess: 0, lost: false, counters: FrameCounters::default() }
    }
}

impl Decoder {
    /// Processes one byte. Returns the payload of the frame that it completes, if any.
    pub fn push(&mut self, byte: u8) -> Option<&[u8]> {
        self.counters.bytes += 1;
        if byte != DELIMITER {
            self.store(byte);
            return None;
        }
        let (length, excess) = (core::mem::take(&mut self.length), core::mem::take(&mut self.excess));
        if length == 0 {
            return None;
        }
        let opened = if excess == 0 { open(&mut self.block[..length]) } else { Err(Fault::Form) };
        match opened {
            Ok(payload) => {
                self.counters.frames += 1;
                self.counters.resyncs += u64::from(core::mem::take(&mut self.lost));
                Some(&self.block[..payload])
            }
            Err(fault) => {
                let count =
                    if let Fault::Crc = fault { &mut self.counters.crc_errors } else { &mut self.counters.malformed };
                *count += 1;
                self.counters.dropped_bytes += length as u64 + excess;
                self.lost = true;
                None
            }
        }
    }

    /// Processes bytes and passes every payload found in them to `each`.
    pub fn feed(&mut self, bytes: &[u8], mut each: impl FnMut(&[u8])) {
        for &byte in bytes {
            if let Some(payload) = self.push(byte) {
                each(payload);
            }
        }
    }

    /// Drops the current block after an interruption of the line.
    pub fn cut(&mut self) {
        self.lost |= self.length > 0;
        self.counters.dropped_bytes += self.length as u64 + self.excess;
        (self.length, self.excess) = (0, 0);
    }

    /// Returns the counters.
    pub fn counters(&self) -> FrameCounters {
        self.counters
    }

    fn store(&mut self, byte: u8) {
        match self.block.get_mut(self.length) {
            Some(place) => {
                *place = byte;
                self.length += 1;
            }
            None => self.excess += 1,
        }
    }
}

/// Decodes a block in place and returns the length of its payload.
fn open(block: &mut [u8]) -> Result<usize, Fault> {
    let length = cobs::decode_in_place(block).map_err(|_| Fault::Form)?;
    let (payload, crc) = block[..length].split_last_chunk::<CRC_BYTES>().ok_or(Fault::Form)?;
    if CRC.checksum(payload) == u32::from_le_bytes(*crc) { Ok(payload.len()) } else { Err(Fault::Crc) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(payload: &[u8]) -> Vec<u8> {
        encode(payload, &mut [0; MAX_FRAME]).unwrap().to_vec()
    }

    fn decode(bytes: &[u8]) -> (Vec<Vec<u8>>, FrameCounters) {
        let (mut decoder, mut found) = (Decoder::default(), Vec::new());
        decoder.feed(bytes, |payload| found.push(payload.to_vec()));
        (found, decoder.counters())
    }

    /// The check value of the catalogue of CRCs, and a frame for comparison with firmware.
    #[test]
    fn a_frame_has_these_bytes() {
        assert_eq!(CRC.checksum(b"123456789"), 0xCBF4_3926);
        assert_eq!(frame(&[1, 0, 2]), [0, 2, 1, 6, 2, 0x09, 0xd2, 0x8d, 0x10, 0]);
    }

    #[test]
    fn the_longest_payload_fits_and_a_longer_one_is_refused() {
        let longest = [7; MAX_PAYLOAD];
        assert_eq!(frame(&longest).len(), MAX_FRAME);
        assert_eq!(decode(&frame(&longest)).0, [longest.to_vec()]);
        assert_eq!(encode(&[7; MAX_PAYLOAD + 1], &mut [0; MAX_FRAME]), Err(TooLong));
    }

    #[test]
    fn invalid_blocks_are_counted() {
        let bytes = [&[0, 1, 2, 3, 0, 2, 5, 0][..], &frame(b"payload"), &vec![9; 2000], &frame(b"again")].concat();
        let (found, counters) = decode(&bytes);
        assert_eq!(found, [b"payload".to_vec(), b"again".to_vec()]);
        assert_eq!((counters.frames, counters.resyncs, counters.crc_errors), (2, 2, 0));
        assert_eq!((counters.malformed, counters.dropped_bytes, counters.bytes), (3, 2005, bytes.len() as u64));
    }

    #[test]
    fn an_interrupted_line_loses_only_one_frame() {
        let whole = frame(b"payload");
        let mut decoder = Decoder::default();
        decoder.feed(&whole[..5], |_| panic!("half a frame is not delivered"));
        decoder.cut();
        let mut found = 0;
        decoder.feed(&whole, |_| found += 1);
        assert_eq!((found, decoder.counters().dropped_bytes, decoder.counters().resyncs), (1, 4, 1));
    }

    fn payload() -> impl Strategy<Value = Vec<u8>> {
        prop::collection::vec(prop_oneof![any::<u8>(), Just(0)], 0..=MAX_PAYLOAD)
    }

    proptest! {
        #[test]
        fn no_bytes_panic_and_all_are_counted(bytes in prop::collection::vec(any::<u8>(), 0..3000)) {
            let (found, counters) = decode(&bytes);
            prop_assert_eq!(found.len() as u64, counters.frames);
            prop_assert_eq!(counters.bytes, bytes.len() as u64);
            prop_assert!(counters.dropped_bytes <= counters.bytes);
        }

        /// Garbage never hides a frame: every frame brings its own delimiters.
        #[test]
        fn every_frame_between_garbage_is_found(parts in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..1200), payload()), 1..8)) {
            let bytes: Vec<u8> = parts.iter().flat_map(|(garbage, payload)| [garbage.clone(), frame(payload)].concat()).collect();
            let (found, _) = decode(&bytes);
            let sent: Vec<&Vec<u8>> = parts.iter().map(|(_, payload)| payload).collect();
            // Random bytes are a valid frame with a probability of 2⁻³² per block.
            prop_assert_eq!(found.iter().filter(|found| sent.contains(found)).count(), sent.len());
        }

        /// A damaged byte, even a delimiter, never yields another payload than the sent one.
        #[test]
        fn a_corrupted_frame_is_never_delivered(payload in payload(), at in any::<prop::sample::Index>(), flip in 1..=255_u8) {
            let mut bytes = frame(&payload);
            let at = at.index(bytes.len());
            bytes[at] ^= flip;
            let (found, counters) = decode(&bytes);
            // A damaged delimiter joins the frame with its surroundings, here nothing.
            prop_assert!(found.iter().all(|found| *found == payload), "{:?}", counters);
            if at > 0 && at < bytes.len() - 1 {
                prop_assert!(found.is_empty());
            }
        }

        #[test]
        fn the_pieces_of_the_stream_do_not_matter(payloads in prop::collection::vec(payload(), 1..5), size in 1..600_usize) {
            let bytes: Vec<u8> = payloads.iter().flat_map(|payload| frame(payload)).collect();
            let (mut decoder, mut found) = (Decoder::default(), Vec::new());
            for piece in bytes.chunks(size) {
                decoder.feed(piece, |payload| found.push(payload.to_vec()));
            }
            prop_assert_eq!(found, payloads);
        }
    }
}
