//! The messages between hosts, as bytes. Pure.
//!
//! Bytes from a network may be anything: they are decoded or refused, and a length in them is never trusted. Must not interpret a
//! sample.

/// A message, and the number of the host that sent it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message<'a> {
    /// The number of the sender.
    pub from: u8,
    /// The payload.
    pub payload: Payload<'a>,
}

/// The payload of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Payload<'a> {
    /// A sample of a link that may lose it: its number among those of this link to this host, and its bytes.
    Sample { link: u16, number: u64, sample: &'a [u8] },
    /// A frame of the lossless stream.
    Frame { number: u64, content: &'a [u8] },
    /// An acknowledgement of all frames before this one.
    Acknowledge { next: u64 },
    /// A heartbeat of a role: the role's number, and the bytes of the sample.
    Health { role: u16, sample: &'a [u8] },
    /// An announcement of the launcher. It holds once the receiver has this number of changes of inputs.
    Schedule { changes: u64, sample: &'a [u8] },
    /// Changes of inputs from this number on, as their words; none in a joined host's request for the next ones.
    Changes { first: u64, changes: &'a [u8] },
    /// A time request: when it was sent, on the sender's clock.
    Ping { sent_ns: u64 },
    /// The answer to a time request: its `sent_ns`, when it was received and answered on the answering host's clock, and that host's
    /// CLOCK_TAI less its monotonic clock.
    Pong { sent_ns: u64, received_ns: u64, answered_ns: u64, tai_offset_ns: u64 },
}

/// The content of a frame of the lossless stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content<'a> {
    /// A sample of a link.
    Sample { link: u16, sample: &'a [u8] },
    /// A file of the run's directory: its name and its bytes.
    File { name: &'a str, bytes: &'a [u8] },
}

/// Reads bytes from the front.
struct Cursor<'a>(&'a [u8]);

impl<'a> Cursor<'a> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take().map(|[byte]| byte)
    }

    fn short(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn long(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn end<T>(&self, read: T) -> Option<T> {
        self.0.is_empty().then_some(read)
    }
}

impl<'a> Message<'a> {
    /// Returns the bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![self.from];
        let mut put = |kind: u8, short: Option<u16>, longs: &[u64], rest: &[u8]| {
            bytes.reserve(3 + 8 * longs.len() + rest.len());
            bytes.push(kind);
            short.iter().for_each(|short| bytes.extend(short.to_le_bytes()));
            longs.iter().for_each(|long| bytes.extend(long.to_le_bytes()));
            bytes.extend(rest);
        };
        match self.payload {
            Payload::Sample { link, number, sample } => put(0, Some(link), &[number], sample),
            Payload::Frame { number, content } => put(1, None, &[number], content),
            Payload::Acknowledge { next } => put(2, None, &[next], &[]),
            Payload::Health { role, sample } => put(3, Some(role), &[], sample),
            Payload::Schedule { changes, sample } => put(4, None, &[changes], sample),
            Payload::Ping { sent_ns } => put(5, None, &[sent_ns], &[]),
            Payload::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns } => {
                put(6, None, &[sent_ns, received_ns, answered_ns, tai_offset_ns], &[]);
            }
            Payload::Changes { first, changes } => put(7, None, &[first], changes),
        }
        bytes
    }

    /// Returns the message in these bytes, or `None` if they are malformed.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let mut cursor = Cursor(bytes);
        let (from, kind) = (cursor.byte()?, cursor.byte()?);
        let payload = match kind {
            0 => Payload::Sample { link: cursor.short()?, number: cursor.long()?, sample: cursor.0 },
            1 => Payload::Frame { number: cursor.long()?, content: cursor.0 },
            2 => {
                let next = cursor.long()?;
                cursor.end(Payload::Acknowledge { next })?
            }
            3 => Payload::Health { role: cursor.short()?, sample: cursor.0 },
            4 => Payload::Schedule { changes: cursor.long()?, sample: cursor.0 },
            5 => {
                let sent_ns = cursor.long()?;
                cursor.end(Payload::Ping { sent_ns })?
            }
            6 => {
                let (sent_ns, received_ns) = (cursor.long()?, cursor.long()?);
                let (answered_ns, tai_offset_ns) = (cursor.long()?, cursor.long()?);
                cursor.end(Payload::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns })?
            }
            7 => Payload::Changes { first: cursor.long()?, changes: cursor.0 },
            _ => return None,
        };
        Some(Self { from, payload })
    }
}

impl<'a> Content<'a> {
    /// Returns the bytes.
    pub fn encode(&self) -> Vec<u8> {
        match *self {
            Self::Sample { link, sample } => [&[0], &link.to_le_bytes()[..], sample].concat(),
            Self::File { name, bytes } => {
                [&[1], &(name.len() as u16).to_le_bytes()[..], name.as_bytes(), bytes].concat()
            }
        }
    }

    /// Returns the content in these bytes, or `None` if they are malformed. A file's name contains no path.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let mut cursor = Cursor(bytes);
        Some(match cursor.byte()? {
            0 => Self::Sample { link: cursor.short()?, sample: cursor.0 },
            1 => {
                let length = usize::from(cursor.short()?);
                let (name, bytes) = cursor.0.split_at_checked(length)?;
                let name = std::str::from_utf8(name).ok()?;
                let harmless = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.');
                let plain = name.bytes().all(harmless) && !name.starts_with('.') && !name.is_empty();
                plain.then_some(Self::File { name, bytes })?
            }
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn decoding_inverts_encoding(from: u8, short: u16, a: u64, b: u64, rest in prop::collection::vec(any::<u8>(), 0..200)) {
            let all = [
                Payload::Sample { link: short, number: a, sample: &rest },
                Payload::Frame { number: a, content: &rest },
                Payload::Acknowledge { next: a },
                Payload::Health { role: short, sample: &rest },
                Payload::Schedule { changes: a, sample: &rest },
                Payload::Changes { first: a, changes: &rest },
                Payload::Ping { sent_ns: a },
                Payload::Pong { sent_ns: a, received_ns: b, answered_ns: a, tai_offset_ns: b },
            ];
            for payload in all {
                let message = Message { from, payload };
                let bytes = message.encode();
                prop_assert_eq!(Message::decode(&bytes), Some(message.clone()));
            }
            for content in [Content::Sample { link: short, sample: &rest }, Content::File { name: "a-1.json", bytes: &rest }] {
                let bytes = content.encode();
                prop_assert_eq!(Content::decode(&bytes), Some(content.clone()));
            }
        }

        #[test]
        fn decoded_bytes_encode_to_themselves(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            if let Some(message) = Message::decode(&bytes) {
                prop_assert_eq!(message.encode(), bytes.clone());
            }
            if let Some(content) = Content::decode(&bytes) {
                prop_assert_eq!(content.encode(), bytes);
            }
        }
    }

    #[test]
    fn a_file_name_with_a_path_is_refused() {
        for name in ["", "../x", "/etc/x", ".x", "a/b", "a b", "a\0"] {
            assert_eq!(Content::decode(&Content::File { name, bytes: b"x" }.encode()), None, "{name}");
        }
    }
}
