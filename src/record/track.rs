//! A recorded signal with its samples: bytes, stamps and columns of numbers.

use crate::sample::{FieldKind, Layout, Order, Place, Stamp};

/// A recorded signal.
#[derive(Debug, Clone)]
pub struct SignalInfo {
    /// The service.
    pub service: String,
    /// The body.
    pub body: String,
    /// The signal's name.
    pub signal: String,
    /// The role that published it.
    pub role: String,
    /// The layout of its samples.
    pub layout: Layout,
    /// Number of samples and no-sample markers.
    pub samples: u64,
    pub(super) channel: u16,
}

/// The samples of one signal, in the order of receipt.
#[derive(Debug)]
pub struct Track {
    /// The signal.
    pub info: SignalInfo,
    /// Time of receipt of each sample, ns on the recorder's monotonic clock.
    pub received_ns: Vec<u64>,
    pub(super) bytes: Vec<u8>,
}

impl Track {
    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.received_ns.len()
    }

    /// Returns true if the signal has no samples.
    pub fn is_empty(&self) -> bool {
        self.received_ns.is_empty()
    }

    /// Returns the bytes of a sample: stamp and content.
    pub fn sample(&self, index: usize) -> &[u8] {
        let size = self.info.layout.size();
        &self.bytes[index * size..][..size]
    }

    /// Returns the stamp of a sample.
    pub fn stamp(&self, index: usize) -> Stamp {
        bytemuck::pod_read_unaligned(&self.sample(index)[..size_of::<Stamp>()])
    }

    /// Returns the first element of an unsigned field in a sample; `None` if there is no such field.
    pub(super) fn unsigned(&self, index: usize, name: &str) -> Option<u64> {
        let column = self.info.layout.columns.iter().find(|column| column.name == name)?;
        (column.kind == FieldKind::U64).then(|| u64::from_le_bytes(self.word(index, column.offset)))
    }

    /// Returns the 8 bytes of a field's element in a sample.
    fn word(&self, index: usize, offset: usize) -> [u8; 8] {
        let mut word = [0; 8];
        word.copy_from_slice(&self.sample(index)[offset..offset + 8]);
        word
    }

    /// Returns a field's element in a sample as a number.
    pub fn value(&self, index: usize, column: usize, element: usize) -> f64 {
        let column = &self.info.layout.columns[column];
        let word = self.word(index, column.offset + 8 * element);
        match column.kind {
            FieldKind::F64 => f64::from_le_bytes(word),
            FieldKind::U64 => u64::from_le_bytes(word) as f64,
        }
    }

    /// Returns the indexes of the regular samples: the first of each tick, in ascending order, without no-sample markers.
    pub fn regular(&self) -> impl Iterator<Item = usize> + '_ {
        let mut order = Order::default();
        (0..self.len())
            .filter(move |index| matches!(order.place(&self.stamp(*index), u64::MAX), Place::Sample | Place::Unused))
    }

    /// Returns a field's element over all [regular](Self::regular) samples; `None` if there is no such field.
    pub fn column(&self, name: &str, element: usize) -> Option<Vec<f64>> {
        let columns = &self.info.layout.columns;
        let column = columns.iter().position(|column| column.name == name && element < column.count)?;
        Some(self.regular().map(|index| self.value(index, column, element)).collect())
    }

    /// Returns the ticks of all [regular](Self::regular) samples.
    pub fn ticks(&self) -> Vec<u64> {
        self.regular().map(|index| self.stamp(index).tick).collect()
    }
}
