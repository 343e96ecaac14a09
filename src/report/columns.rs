//! A signal of any length in a bounded number of columns that keep its extremes.
//!
//! When the number of columns would exceed the limit, each pair is merged into one. Must not smooth or sample: a column
//! contains every value that the signal reached in its ticks.

/// The largest number of columns. A signal with at least as many ticks has at least half as many columns.
pub const COLUMNS: usize = 1400;

/// The values that a column keeps of its ticks.
pub trait Column: Clone + Default {
    /// Merges the following column into this one.
    fn absorb(&mut self, later: &Self);
}

/// Columns of equal width, starting at tick 0.
#[derive(Debug, Clone)]
pub struct Columns<C> {
    /// Ticks per column, a power of two.
    stride: u64,
    columns: Vec<C>,
}

/// The first, smallest and largest value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extremes {
    pub first: f64,
    pub min: f64,
    pub max: f64,
}

/// The first point of a path and its outermost points on each side, with their ticks.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Corners([Option<(u64, f64, f64)>; 5]);

/// A number of ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Count(pub u64);

impl<C> Default for Columns<C> {
    fn default() -> Self {
        Self { stride: 1, columns: Vec::new() }
    }
}

impl<C: Column> Columns<C> {
    /// Returns the column of a tick, for writing.
    pub fn at(&mut self, tick: u64) -> &mut C {
        while tick / self.stride >= COLUMNS as u64 {
            self.halve();
        }
        let index = (tick / self.stride) as usize;
        if index >= self.columns.len() {
            self.columns.resize(index + 1, C::default());
        }
        &mut self.columns[index]
    }

    fn halve(&mut self) {
        let merged = self.columns.chunks(2).map(|pair| {
            let mut column = pair[0].clone();
            pair.iter().skip(1).for_each(|later| column.absorb(later));
            column
        });
        (self.columns, self.stride) = (merged.collect(), self.stride * 2);
    }

    /// Ticks per column.
    pub fn stride(&self) -> u64 {
        self.stride
    }

    /// Returns every column with its first tick.
    pub fn iter(&self) -> impl Iterator<Item = (u64, &C)> {
        self.columns.iter().enumerate().map(|(index, column)| (index as u64 * self.stride, column))
    }
}

impl Default for Extremes {
    /// The extremes of no value: `min` is greater than `max`.
    fn default() -> Self {
        Self { first: f64::NAN, min: f64::INFINITY, max: f64::NEG_INFINITY }
    }
}

impl Extremes {
    /// Adds a value; ignores one that is not finite.
    pub fn take(&mut self, value: f64) {
        if value.is_finite() {
            self.absorb(&Self { first: value, min: value, max: value });
        }
    }

    /// Returns true if no value has been added.
    pub fn is_empty(&self) -> bool {
        self.min > self.max
    }
}

impl Column for Extremes {
    fn absorb(&mut self, later: &Self) {
        if self.is_empty() {
            self.first = later.first;
        }
        (self.min, self.max) = (self.min.min(later.min), self.max.max(later.max));
    }
}

impl Corners {
    /// Adds a point; ignores one that is not finite.
    pub fn take(&mut self, tick: u64, x: f64, y: f64) {
        if x.is_finite() && y.is_finite() {
            self.absorb(&Self([Some((tick, x, y)); 5]));
        }
    }

    /// Returns the points in the order of time.
    pub fn points(&self) -> Vec<(f64, f64)> {
        let mut points: Vec<(u64, f64, f64)> = self.0.iter().flatten().copied().collect();
        points.sort_by_key(|point| point.0);
        points.dedup_by_key(|point| point.0);
        points.into_iter().map(|(_, x, y)| (x, y)).collect()
    }
}

impl Column for Corners {
    fn absorb(&mut self, later: &Self) {
        type Farther = fn((u64, f64, f64), (u64, f64, f64)) -> bool;
        let farther: [Farther; 5] =
            [|_, _| false, |a, b| b.1 < a.1, |a, b| b.1 > a.1, |a, b| b.2 < a.2, |a, b| b.2 > a.2];
        for ((own, later), farther) in self.0.iter_mut().zip(later.0).zip(farther) {
            if let Some(later) = later
                && own.is_none_or(|own| farther(own, later))
            {
                *own = Some(later);
            }
        }
    }
}

impl Column for Count {
    fn absorb(&mut self, later: &Self) {
        self.0 += later.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Columns keep a spike of one tick among 100 000, in either direction and at any place.
    #[test]
    fn merged_columns_keep_every_extreme() {
        for spike in [0, 1, 77_777, 99_999] {
            let (mut wave, mut path) = (Columns::<Extremes>::default(), Columns::<Corners>::default());
            for tick in 0..100_000_u64 {
                let x = (tick as f64 * 1e-4).sin();
                let (up, down) = (if tick == spike { 5.0 } else { x }, if tick == spike { -7.0 } else { x });
                wave.at(tick).take(up);
                wave.at(tick).take(down);
                path.at(tick).take(tick, up, down);
            }
            assert!(wave.iter().count() <= COLUMNS && wave.iter().count() > COLUMNS / 2, "{}", wave.iter().count());
            let (first, column) = wave.iter().find(|(_, column)| column.max == 5.0).unwrap();
            assert!(first <= spike && spike < first + wave.stride() && column.min == -7.0, "{spike}: {column:?}");
            let outermost = path.iter().flat_map(|(_, corners)| corners.points()).filter(|point| *point == (5.0, -7.0));
            assert_eq!(outermost.count(), 1, "{spike}");
        }
    }

    #[test]
    fn a_short_signal_has_one_column_per_tick_and_keeps_its_gaps() {
        let mut columns = Columns::<Extremes>::default();
        for tick in [0, 1, 4] {
            columns.at(tick).take(tick as f64);
        }
        columns.at(3).take(f64::NAN);
        let present: Vec<_> = columns.iter().map(|(tick, column)| (tick, !column.is_empty())).collect();
        assert_eq!(present, [(0, true), (1, true), (2, false), (3, false), (4, true)]);
    }

    #[test]
    fn merging_columns_preserves_the_total_count() {
        let mut counts = Columns::<Count>::default();
        (0..123_456).for_each(|tick| counts.at(tick).0 += 1);
        assert_eq!(counts.iter().map(|(_, count)| count.0).sum::<u64>(), 123_456);
    }

    #[test]
    fn the_largest_possible_tick_takes_no_more_columns() {
        let mut counts = Columns::<Count>::default();
        counts.at(3).0 += 1;
        counts.at(u64::MAX).0 += 1;
        assert!(counts.iter().count() <= COLUMNS);
    }
}
