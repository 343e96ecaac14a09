//! Measures the decay rate of one run's error, from where it is small to its floor.
//!
//! Must not know the meaning of the errors.

/// An error is small below this fraction of its largest value.
const SMALL: f64 = 1e-2;
/// Above this multiple of its floor an error falls freely.
const FREE: f64 = 20.0;
/// A rate is measured over a fall by this factor.
const DEPTH: f64 = 1e3;
/// Fractions of the motion's size: the distance that it must have gone, and the distance to which it must return.
const GONE: f64 = 0.05;
const BACK: f64 = 0.02;

/// The errors of a run and the motion that it follows, tick by tick.
#[derive(Default)]
pub(super) struct Fall {
    /// Per metric, the error of every tick.
    errors: Vec<Vec<f64>>,
    first: Vec<f64>,
    before: Vec<f64>,
    /// The motion's distance from its start, and from the previous tick.
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

    /// Returns the period of the motion, ticks: 1 if it rests, `None` if it does not return.
    fn period(&self) -> Option<usize> {
        let size = distance(&self.first, &vec![0.0; self.first.len()]);
        let Some(gone) = self.away.iter().position(|[away, _]| *away > GONE * size) else { return Some(1) };
        let near = |(tick, now): (usize, &[[f64; 2]])| {
            let [[before, _], [away, step], [after, _]] = [now[0], now[1], now[2]];
            (away <= before && away < after && away <= BACK * size + step).then_some(gone + 1 + tick)
        };
        self.away[gone..].windows(3).enumerate().find_map(near)
    }

    /// Returns two rates per tick: over the last decades, and by the least-squares line over the whole fall. Each covers whole
    /// periods of the motion. Returns `None` if the fall ends before.
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

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
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
    fn an_exponential_has_its_rate_and_a_double_mode_has_a_lower_one() {
        let rests = |_: f64| 1.0;
        let [last, all] = fall(400, |tick| (-0.1 * tick).exp().max(1e-15), rests).rates(&[1e-15]).unwrap();
        assert!((last - 0.1).abs() < 1e-9 && (all - 0.1).abs() < 1e-9);
        let [last, all] = fall(800, |tick| (1.0 + tick).powi(2) * (-0.1 * tick).exp(), rests).rates(&[1e-15]).unwrap();
        assert!(last < 0.1 / 1.048 && all < 0.1 / 1.048, "{last} {all}");
    }

    #[test]
    fn a_fall_shorter_than_the_motions_period_has_no_rate() {
        let turns = |period: f64| move |tick: f64| core::f64::consts::TAU * tick / period;
        let falls = |tick: f64| (-0.1 * tick).exp().max(1e-15);
        assert!(fall(400, falls, turns(300.0)).rates(&[1e-15]).is_none());
        assert!(fall(400, falls, turns(40.0)).rates(&[1e-15]).is_some());
    }
}
