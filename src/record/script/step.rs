//! The executed ticks of a role and the samples to feed, and the end of the part that can be compared.

use crate::record::track::Track;
use crate::sample::{NO_SAMPLE, Stamp};

/// One executed tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step {
    /// The tick.
    pub tick: u64,
    /// The generation of the role.
    pub generation: u64,
    /// True if the role finished the tick before it died.
    pub finished: bool,
}

/// One sample to feed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item {
    /// Index of a recorded sample.
    Recorded(usize),
    /// A no-sample marker: its tick, and the generation of its sender.
    NoSample(u64, u64),
}

/// One input of a role.
#[derive(Debug)]
pub struct InputScript {
    /// The recorded samples.
    pub track: Track,
    /// The samples and markers to feed.
    pub items: Vec<Item>,
    /// Per step, the range of the items to feed: first, and one past the last.
    pub spans: Vec<[usize; 2]>,
}

impl InputScript {
    /// Writes the bytes of an item to `bytes`.
    pub fn write(&self, item: usize, bytes: &mut Vec<u8>) {
        bytes.clear();
        match self.items[item] {
            Item::Recorded(index) => bytes.extend_from_slice(self.track.sample(index)),
            Item::NoSample(tick, generation) => {
                let stamp = Stamp { tick, generation: generation | NO_SAMPLE, ..Stamp::default() };
                bytes.extend_from_slice(bytemuck::bytes_of(&stamp));
                bytes.resize(self.track.info.layout.size(), 0);
            }
        }
    }
}

/// The end of the part of a recording that can be compared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limit {
    /// The first tick that cannot be compared.
    pub tick: u64,
    /// The reason.
    pub reason: String,
}
