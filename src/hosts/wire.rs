//! What hosts send one another, as bytes. Pure. What comes from a network may be anything: it is read or refused, and never trusted
//! with a length. Must not know what a sample means.

/// A message, and the number of the host that sent it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message<'a> {
    /// The number of the sender.
    pub from: u8,
    /// What it says.
    pub what: What<'a>,
}

/// What a message says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum What<'a> {
    /// The sample of a link, which may be lost: its number among those of this link to this host, and its bytes.
    Sample { link: u16, number: u64, sample: &'a [u8] },
    /// A frame of the stream that loses nothing.
    Frame { number: u64, content: &'a [u8] },
    /// All frames before this one have come.
    Acknowledge { next: u64 },
    /// How a role is: its number, and the bytes of its health.
    Health { role: u16, sample: &'a [u8] },
    /// The launcher's word.
    Schedule { sample: &'a [u8] },
    /// A question for the time: when it was sent there.
    Ping { sent_ns: u64 },
    /// The answer: that time, when it came and went here, and from this host's monotonic clock to its CLOCK_TAI.
    Pong { sent_ns: u64, received_ns: u64, answered_ns: u64, tai_offset_ns: u64 },
}

/// What a frame of the stream holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content<'a> {
    /// The sample of a link.
    Sample { link: u16, sample: &'a [u8] },
    /// A file of the run's directory: its name, and what is in it.
    File { name: &'a str, bytes: &'a [u8] },
}

/// Reads from the front.
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
    /// Its bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![self.from];
        let mut put = |kind: u8, short: Option<u16>, longs: &[u64], rest: &[u8]| {
            bytes.reserve(3 + 8 * longs.len() + rest.len());
            bytes.push(kind);
            short.iter().for_each(|short| bytes.extend(short.to_le_bytes()));
            longs.iter().for_each(|long| bytes.extend(long.to_le_bytes()));
            bytes.extend(rest);
        };
        match self.what {
            What::Sample { link, number, sample } => put(0, Some(link), &[number], sample),
            What::Frame { number, content } => put(1, None, &[number], content),
            What::Acknowledge { next } => put(2, None, &[next], &[]),
            What::Health { role, sample } => put(3, Some(role), &[], sample),
            What::Schedule { sample } => put(4, None, &[], sample),
            What::Ping { sent_ns } => put(5, None, &[sent_ns], &[]),
            What::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns } => {
                put(6, None, &[sent_ns, received_ns, answered_ns, tai_offset_ns], &[]);
            }
        }
        bytes
    }

    /// The message in these bytes, if they are one.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let mut cursor = Cursor(bytes);
        let (from, kind) = (cursor.byte()?, cursor.byte()?);
        let what = match kind {
            0 => What::Sample { link: cursor.short()?, number: cursor.long()?, sample: cursor.0 },
            1 => What::Frame { number: cursor.long()?, content: cursor.0 },
            2 => {
                let next = cursor.long()?;
                cursor.end(What::Acknowledge { next })?
            }
            3 => What::Health { role: cursor.short()?, sample: cursor.0 },
            4 => What::Schedule { sample: cursor.0 },
            5 => {
                let sent_ns = cursor.long()?;
                cursor.end(What::Ping { sent_ns })?
            }
            6 => {
                let (sent_ns, received_ns) = (cursor.long()?, cursor.long()?);
                let (answered_ns, tai_offset_ns) = (cursor.long()?, cursor.long()?);
                cursor.end(What::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns })?
            }
            _ => return None,
        };
        Some(Self { from, what })
    }
}

impl<'a> Content<'a> {
    /// Its bytes.
    pub fn encode(&self) -> Vec<u8> {
        match *self {
            Self::Sample { link, sample } => [&[0], &link.to_le_bytes()[..], sample].concat(),
            Self::File { name, bytes } => {
                [&[1], &(name.len() as u16).to_le_bytes()[..], name.as_bytes(), bytes].concat()
            }
        }
    }

    /// The content in these bytes, if they are one. A file's name is one: it leads nowhere.
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
        fn what_is_written_is_read(from: u8, short: u16, a: u64, b: u64, rest in prop::collection::vec(any::<u8>(), 0..200)) {
            let all = [
                What::Sample { link: short, number: a, sample: &rest },
                What::Frame { number: a, content: &rest },
                What::Acknowledge { next: a },
                What::Health { role: short, sample: &rest },
                What::Schedule { sample: &rest },
                What::Ping { sent_ns: a },
                What::Pong { sent_ns: a, received_ns: b, answered_ns: a, tai_offset_ns: b },
            ];
            for what in all {
                let message = Message { from, what };
                let bytes = message.encode();
                prop_assert_eq!(Message::decode(&bytes), Some(message.clone()));
            }
            for content in [Content::Sample { link: short, sample: &rest }, Content::File { name: "a-1.json", bytes: &rest }] {
                let bytes = content.encode();
                prop_assert_eq!(Content::decode(&bytes), Some(content.clone()));
            }
        }

        #[test]
        fn anything_may_come(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            if let Some(message) = Message::decode(&bytes) {
                prop_assert_eq!(message.encode(), bytes.clone());
            }
            if let Some(content) = Content::decode(&bytes) {
                prop_assert_eq!(content.encode(), bytes);
            }
        }
    }

    #[test]
    fn a_file_lies_in_its_directory() {
        for name in ["", "../x", "/etc/x", ".x", "a/b", "a b", "a\0"] {
            assert_eq!(Content::decode(&Content::File { name, bytes: b"x" }.encode()), None, "{name}");
        }
    }
}
