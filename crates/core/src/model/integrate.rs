//! Fixed-step integration of an autonomous ordinary differential equation whose input is held over the step.
//!
//! The step must not adapt to an error estimate: equal states and steps always have the same cost and result.

use nalgebra::SVector;

/// The maximum number of steps per call. A body at extreme rates loses accuracy, but does not miss the deadline.
const MAX_STEPS: f64 = 10_000.0;

/// Takes one classical fourth-order Runge-Kutta step of `x' = f(x)` over `h` seconds.
#[inline]
pub fn rk4_step<const N: usize>(
    f: impl Fn(&SVector<f64, N>) -> SVector<f64, N>,
    x: &SVector<f64, N>,
    h: f64,
) -> SVector<f64, N> {
    let k1 = f(x);
    let k2 = f(&(x + k1 * (0.5 * h)));
    let k3 = f(&(x + k2 * (0.5 * h)));
    let k4 = f(&(x + k3 * h));
    x + (k1 + (k2 + k3) * 2.0 + k4) * (h / 6.0)
}

/// Returns the number of equal steps of at most `max_step_s` in `dt_s`.
#[inline]
pub(super) fn steps(dt_s: f64, max_step_s: f64) -> f64 {
    // Most ticks need one step.
    if dt_s <= max_step_s {
        return 1.0;
    }
    // The tolerance keeps a tick that equals the bound up to rounding at one step.
    libm::ceil(dt_s / max_step_s - 1e-6).clamp(1.0, MAX_STEPS)
}

/// Advances `x` along `x' = f(x)` by `dt_s` seconds in equal Runge-Kutta steps of at most `max_step_s`.
///
/// `dt_s` is finite and not negative, `max_step_s` positive; a step of zero returns `x`.
#[inline]
pub fn flow<const N: usize>(
    f: impl Fn(&SVector<f64, N>) -> SVector<f64, N>,
    x: &SVector<f64, N>,
    dt_s: f64,
    max_step_s: f64,
) -> SVector<f64, N> {
    let steps = steps(dt_s, max_step_s);
    let h = dt_s / steps;
    let mut x = *x;
    for _ in 0..steps as u64 {
        x = rk4_step(&f, &x, h);
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    fn oscillator(x: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(x.y, -x.x)
    }

    #[test]
    fn the_error_falls_with_the_fourth_power_of_the_step() {
        let exact = Vector2::new(libm::cos(1.0), -libm::sin(1.0));
        let error = |step| (flow(oscillator, &Vector2::new(1.0, 0.0), 1.0, step) - exact).norm();
        let order = libm::log2(error(0.02) / error(0.01));
        assert!((order - 4.0).abs() < 0.05, "order {order}");
    }

    #[test]
    fn a_tick_equal_to_the_bound_takes_one_step() {
        let x = Vector2::new(1.0, 0.0);
        assert_eq!(flow(oscillator, &x, 0.1 * 3.0, 0.3), rk4_step(oscillator, &x, 0.1 * 3.0));
        assert_eq!(flow(oscillator, &x, 0.0, 0.3), x);
    }
}
