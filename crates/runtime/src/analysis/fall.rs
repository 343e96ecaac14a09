//! How fast the error of one run falls, from where it is small to its floor.
//!
//! Must not know what the errors are of.

/// An error is small below this part of its largest.
const SMALL: f64 = 1e-2;
/// So many times its floor it still falls freely.
const FREE: f64 = 20.0;
/// A rate is told by a fall so deep.
const DEPTH: f64 = 1e3;
/// Of the motion's size: so far it must have gone, and so near it must come back.
const GONE: f64 = 0.05;
const BACK: f64 = 0.02;

/// The errors of a run, and the motion that is followed, tick by tick.
#[derive(Default)]
pub(super) struct Fall {
    /// By metric.
    errors: Vec<Vec<f64>>,
    first: Vec<f64>,
    before: Vec<f64>,
    /// How far the motion is from where it began, and how far it has gone since the tick before.
    away: Vec<[f64; 2]>,
}

impl Fall {
    pub fn push(&mut self, errors: &[f64], motion: &[f64]) {
        self.errors.resize(errors.len(), Vec::new());
        self.errors.iter_mut().zip(errors).for_each(|(errors, error)| errors.push(*error));
        if self.away.is_empty() {
            self.first.extend(motion);
            self.before.extend(motion);
        }
        self.away.push([distance(motion, &self.first), distance(motion, &self.before)]);
        self.before.copy_from_slice(motion);
    }

    /// The ticks after which the motion is what it was: one if it rests, none if it does not come back.
    fn period(&self) -> Option<usize> {
        let size = distance(&self.first, &vec![0.0; self.first.len()]);
        let Some(gone) = self.away.iter().position(|[away, _]| *away > GONE * size) else { return Some(1) };
        let near = |(tick, now): (usize, &[[f64; 2]])| {
            let [[before, _], [away, step], [after, _]] = [now[0], now[1], now[2]];
            (away <= before && away < after && away <= BACK * size + step).then_some(gone + 1 + tick)
        };
        self.away[gone..].windows(3).enumerate().find_map(near)
    }

    /// Two rates per tick: over the last decades, and by the nearest straight line over all; each over whole periods of the
    /// motion. None where the fall is over before.
    pub fn rates(&self, floors: &[f64]) -> Option<[f64; 2]> {
        let largest: Vec<f64> =
            self.errors.iter().map(|errors| errors.iter().copied().fold(f64::MIN_POSITIVE, f64::max)).collect();
        let parts =
            |tick: usize| self.errors.iter().zip(&largest).map(move |(errors, largest)| errors[tick] / largest).sum();
        let all: Vec<f64> = (0..self.away.len()).map(parts).collect();
        let floor: f64 = floors.iter().zip(&largest).map(|(floor, largest)| floor / largest).sum();
        let end = all.iter().position(|error| *error <= FREE * floor.max(1e-14))?;
        let small = all[..end].iter().rposition(|error| *error >= SMALL).map_or(0, |tick| tick + 1);
        let begin = all[..end].iter().rposition(|error| *error >= DEPTH * all[end])?;
        let begin = end.checked_sub((end - begin).next_multiple_of(self.period()?)).filter(|begin| *begin >= small)?;
        let last = (all[begin] / all[end]).ln() / (end - begin) as f64;
        let logarithms: Vec<f64> = all[small..end].iter().map(|error| -error.ln()).collect();
        Some([last, super::exponent::slope(&logarithms)])
    }
}

fn distance(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other) * (one - other)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fall(ticks: usize, error: impl Fn(f64) -> f64, motion: impl Fn(f64) -> f64) -> Fall {
        let mut fall = Fall::default();
        let each = |tick: f64| fall.push(&[error(tick)], &[motion(tick).sin(), motion(tick).cos()]);
        (0..ticks).map(|tick| tick as f64).for_each(each);
        fall
    }

    #[test]
    fn a_fall_has_its_rate_and_two_that_are_nearly_alike_have_none() {
        let rests = |_: f64| 1.0;
        let [last, all] = fall(400, |tick| (-0.1 * tick).exp().max(1e-15), rests).rates(&[1e-15]).unwrap();
        assert!((last - 0.1).abs() < 1e-9 && (all - 0.1).abs() < 1e-9);
        let [last, all] = fall(800, |tick| (1.0 + tick).powi(2) * (-0.1 * tick).exp(), rests).rates(&[1e-15]).unwrap();
        assert!(last < 0.1 / 1.048 && all < 0.1 / 1.048, "{last} {all}");
    }

    #[test]
    fn what_is_over_before_the_motion_comes_back_tells_no_rate() {
        let turns = |period: f64| move |tick: f64| core::f64::consts::TAU * tick / period;
        let falls = |tick: f64| (-0.1 * tick).exp().max(1e-15);
        assert!(fall(400, falls, turns(300.0)).rates(&[1e-15]).is_none());
        assert!(fall(400, falls, turns(40.0)).rates(&[1e-15]).is_some());
    }
}
