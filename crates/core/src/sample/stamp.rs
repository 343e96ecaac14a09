//! The header of every sample, and the marker of a tick without one.

use super::field::{Field, FieldKind};

/// The header of every sample.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Stamp {
    /// The tick k; the sample belongs to the instant T_k.
    pub tick: u64,
    /// The number of the sender's starts in this run, from 1. 0 marks a warm-up sample, which no role uses.
    pub generation: u64,
    /// The due time of the tick at the body whose measurement began this chain, ns on the monotonic clock. Copied
    /// from input to output.
    pub origin_ns: u64,
    /// The time at which the sample was handed to the link, ns on the monotonic clock.
    pub sent_ns: u64,
}

impl Stamp {
    /// Takes tick and origin of the sample to which this one is the answer.
    #[inline(always)]
    pub fn answer(&mut self, input: &Self) {
        (self.tick, self.origin_ns) = (input.tick, input.origin_ns);
    }

    /// The fields, in order.
    pub const FIELDS: [Field; 4] = [
        Self::field("tick", core::mem::offset_of!(Self, tick)),
        Self::field("generation", core::mem::offset_of!(Self, generation)),
        Self::field("origin_ns", core::mem::offset_of!(Self, origin_ns)),
        Self::field("sent_ns", core::mem::offset_of!(Self, sent_ns)),
    ];

    /// Returns true for a warm-up sample. A sample of a later tick is not one, even if a fault has cleared its
    /// generation.
    #[inline]
    pub fn is_warm_up(&self) -> bool {
        (self.tick, self.generation) == (0, 0)
    }

    const fn field(name: &'static str, offset: usize) -> Field {
        Field { name, offset, kind: FieldKind::U64, count: 1 }
    }
}

/// The bit of a stamp's generation that marks a no-sample marker: there is no sample of this tick, and there will not be
/// one.
///
/// Roles that wait for their inputs (lockstep, one thread) would stop at a missing sample; the marker takes its
/// place. Readers count it and treat the tick like one whose sample was lost. Real time does not need it.
pub const NO_SAMPLE: u64 = 1 << 63;
