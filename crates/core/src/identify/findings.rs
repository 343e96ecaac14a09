//! The conclusions from a log about the body, and their limits, as sentences.

use super::axes::AxesFit;
use super::motion::{GROUPS, Motion, Sums};
use super::nearest_body;
use super::tensor::TensorFit;
use nalgebra::Vector3;

/// The number of standard deviations that counts as certain.
const CERTAIN: f64 = 3.0;
/// The part of a rate below which the motion does not obey Euler's equations, and the part of the motion of all rates that may
/// be unexplained.
const EXPLAINED: f64 = 0.9;
const NEGLIGIBLE: f64 = 0.01;
/// The deviation of a1 + a2 + a3 + a1 a2 a3 from 0, and of a coefficient beyond 1, from which no body has the coefficients.
const OPEN: f64 = 0.1;
/// Factors between rates in wrong units, of rate or time, and right ones: deg/s, mdps, mrad/s or ms, us, ns, rpm, rev/s; and those of
/// counters, so that none of these is taken for a unit.
pub(crate) const SCALES: [f64; 11] = [
    core::f64::consts::PI / 180.0,
    core::f64::consts::PI / 180e3,
    1e-3,
    1e-6,
    1e-9,
    core::f64::consts::TAU / 60.0,
    core::f64::consts::TAU,
    1e-1,
    1e-2,
    1e-4,
    1e-5,
];
/// The least ratio of the unexplained parts at the wrong and at the right scale, the largest unexplained part at the right one, and
/// the least at the wrong one where the right one is not that of a unit.
const BETTER: f64 = 4.0;
const WELL: f64 = 0.02;
const ILL: f64 = 2e-4;
/// The least ratio of the unexplained parts where the right scale is not that of a unit.
const FAR: f64 = 10.0;
/// The factor by which a scale differs from another, and the part of the gain of the right one that it loses at least.
const APART: f64 = 1.25;
const ALIKE: f64 = 0.03;
/// The parts of the mean square of the rates, about another axis than the first, up to which a body turns about one axis: in any log,
/// and in one where it is below four times the noise.
const ONE_AXIS: [f64; 2] = [1e-8, 1e-3];
/// The standard deviation from which a coefficient counts as unknown (no body's exceeds 1), and, where that is
/// unknown, the least ratio of its effect on the rate to the residual.
const UNKNOWN: f64 = 0.3;
const EXCITED: f64 = 0.5;
/// The least ratio of the next tensor's fit to the best one's at which the tensor counts as known.
const DISTINCT: f64 = 2.0;
/// The least number of samples.
const FEW_SAMPLES: u64 = 20;
/// The angle between a sensor's axis and a principal one from which the sensor counts as turned, rad.
const TILTED_RAD: f64 = 0.05;
/// The letters of the axes.
const AXES: [&str; 3] = ["x", "y", "z"];

/// A conclusion about a result; [`Display`](std::fmt::Display) prints it as a sentence.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Finding {
    /// The scale is unknown.
    #[error("only ratios of moments can be known from a free motion; for kg m2 multiply by one moment that you know")]
    Scale,
    /// The log is too short.
    #[error("the log is too short: {samples} samples; a fit needs at least {FEW_SAMPLES}")]
    Short {
        /// The number of samples.
        samples: u64,
    },
    /// There are too few pieces for resampling.
    #[error(
        "no uncertainty: the log has {pieces} pieces of motion, but 4 are required; log more segments, or longer ones"
    )]
    FewPieces {
        /// The number of pieces.
        pieces: u64,
    },
    /// The body hardly turned.
    #[error("the body turned by only {turn_rad:.2} rad in all; log a faster or longer motion")]
    Still {
        /// The total angle.
        turn_rad: f64,
    },
    /// The body turned about one axis.
    #[error(
        "the body turned about one axis only, {} in the sensor's axes, which tells nothing about its moments; log a motion about \
         all axes",
        three(direction)
    )]
    OneAxis {
        /// The axis.
        direction: Vector3<f64>,
    },
    /// Motions in other units look alike.
    #[error(
        "the units were assumed, and this motion would be that of a body in other units too; make sure of them, or give them with \
         --rate-unit and --time-unit"
    )]
    Units,
    /// The motion does not depend on one coefficient.
    #[error(
        "a{} is not known by this log: what it does to the rate about {} ({excitation_rad_s:.2e} rad/s) is too little beside \
         what the fit leaves ({residual_rad_s:.2e} rad/s); log a motion about all axes", axis + 1, AXES[*axis]
    )]
    Unexcited {
        /// The index of the axis.
        axis: usize,
        /// The root mean square effect of a unit of the coefficient.
        excitation_rad_s: f64,
        /// The root mean square residual.
        residual_rad_s: f64,
    },
    /// All coefficients may be zero.
    #[error(
        "the body cannot be told from a sphere: no coefficient differs from 0 by 3 standard deviations; no hidden rate can be \
         estimated from the others"
    )]
    Sphere,
    /// Two moments may be equal.
    #[error(
        "the moments about {} and {} cannot be told apart: the body may be symmetric about {}; the directions of these two \
         axes mean nothing then", AXES[(axis + 1) % 3], AXES[(axis + 2) % 3], AXES[*axis]
    )]
    Symmetric {
        /// The index of the axis of symmetry.
        axis: usize,
    },
    /// No free rigid body moves so.
    #[error(
        "this motion is not that of a free rigid body{}: R2 = {}, coefficients = {}, a1 + a2 + a3 + a1 a2 a3 = {closure:.3}, \
         moments = {}; cut out the free motion{}",
        if *whole { "" } else { " about the sensor's axes" }, three(r_squared), three(coefficients), three(moments),
        if *whole { "" } else { ", or look at the whole tensor" }
    )]
    NotFree {
        /// True for the whole tensor.
        whole: bool,
        /// The explained part of each rate's variance.
        r_squared: Vector3<f64>,
        /// The coefficients of Euler's equations.
        coefficients: Vector3<f64>,
        /// Their identity, zero for every body.
        closure: f64,
        /// The moments of the best fit, the largest 1.
        moments: Vector3<f64>,
    },
    /// The rates, or the times, have another unit.
    #[error(
        "Euler's equations hold if the rates are {factor:.3e} times as large, or the times: the unit is another one; give that of \
         the rates (deg/s?) or of the stamps (ms?)"
    )]
    Scaled {
        /// The factor.
        factor: f64,
    },
    /// The air damps the motion.
    #[error(
        "a torque acts: the motion is damped at {damping_per_s:.3} 1/s (standard deviation {deviation_per_s:.3}); it is part of \
         the fit, and an estimate needs it"
    )]
    Damped {
        /// The damping.
        damping_per_s: f64,
        /// Its standard deviation.
        deviation_per_s: f64,
    },
    /// A torque drives the body.
    #[error(
        "energy comes in: the rates grow at {growth_per_s:.3} 1/s (standard deviation {deviation_per_s:.3}); a torque drives the \
         body, so it is no free motion"
    )]
    Driven {
        /// The growth of the rates.
        growth_per_s: f64,
        /// Its standard deviation.
        deviation_per_s: f64,
    },
    /// Euler's equations about these axes do not explain a rate.
    #[error(
        "Euler's equations about the sensor's axes explain only {:.1} % of the rate about {}: a torque acts, or the axes are not \
         principal ones; look at the whole tensor", 100.0 * r_squared, AXES[*axis]
    )]
    Unexplained {
        /// The index of the axis.
        axis: usize,
        /// The part that is explained.
        r_squared: f64,
    },
    /// The three coefficients do not belong to one body.
    #[error(
        "a1 + a2 + a3 + a1 a2 a3 = {closure:.3} is not zero within 3 standard deviations ({deviation:.3}): a torque acts, or the \
         axes are not principal ones, or not at right angles"
    )]
    Open {
        /// The sum.
        closure: f64,
        /// Its standard deviation.
        deviation: f64,
    },
    /// The sensor is turned against the body.
    #[error(
        "the sensor's axes are up to {:.1} degrees from the principal ones; give these axes to an estimate",
        tilt_rad.to_degrees()
    )]
    Tilted {
        /// The largest angle.
        tilt_rad: f64,
    },
    /// Another tensor fits nearly as well.
    #[error(
        "{} not known by this log: another one fits nearly as well (ratio {distinction:.2}); log a motion about all axes",
        if *whole { "the whole tensor is" } else { "the body about the sensor's axes is" }
    )]
    Indistinct {
        /// True for the whole tensor.
        whole: bool,
        /// The ratio of the fits.
        distinction: f64,
    },
    /// The motion does not show the wheel as given.
    #[error(
        "the motion does not show the wheel as given: with it, the largest moment {}would be {largest:.3e} kg m2{}; check its \
         sign and its axes, or log a longer motion",
        if *whole { "" } else { "about the sensor's axes " },
        deviation.map_or(String::new(), |deviation| format!(" (standard deviation {deviation:.1e})"))
    )]
    Wheel {
        /// True for the whole tensor.
        whole: bool,
        /// The largest moment.
        largest: f64,
        /// Its standard deviation, if it is known.
        deviation: Option<f64>,
    },
}

impl From<&Finding> for &'static str {
    /// Returns the stable name of the finding.
    fn from(finding: &Finding) -> Self {
        match finding {
            Finding::Scale => "scale-unknown",
            Finding::Short { .. } => "log-too-short",
            Finding::FewPieces { .. } => "few-pieces",
            Finding::Still { .. } => "hardly-a-motion",
            Finding::OneAxis { .. } => "one-axis",
            Finding::Units => "units-assumed",
            Finding::Unexcited { .. } => "unexcited",
            Finding::Sphere => "sphere",
            Finding::Symmetric { .. } => "symmetric",
            Finding::NotFree { .. } => "not-free",
            Finding::Scaled { .. } => "implausible-unit",
            Finding::Damped { .. } => "damped",
            Finding::Driven { .. } => "driven",
            Finding::Unexplained { .. } => "unexplained",
            Finding::Open { .. } => "not-closed",
            Finding::Tilted { .. } => "tilted",
            Finding::Indistinct { .. } => "indistinct",
            Finding::Wheel { .. } => "no-such-wheel",
        }
    }
}

impl Finding {
    /// Returns true if the finding rules out a body about the sensor's axes.
    pub fn forbids_axes(&self) -> bool {
        matches!(
            self,
            Self::Short { .. }
                | Self::Still { .. }
                | Self::OneAxis { .. }
                | Self::Unexcited { .. }
                | Self::Scaled { .. }
                | Self::NotFree { whole: false, .. }
                | Self::Indistinct { whole: false, .. }
                | Self::Wheel { whole: false, .. }
        )
    }

    /// Returns true if the finding rules out a whole tensor.
    pub fn forbids_tensor(&self) -> bool {
        matches!(
            self,
            Self::Short { .. }
                | Self::Still { .. }
                | Self::OneAxis { .. }
                | Self::Indistinct { whole: true, .. }
                | Self::Scaled { .. }
                | Self::NotFree { whole: true, .. }
                | Self::Wheel { whole: true, .. }
        )
    }
}

/// Returns three numbers as text.
fn three(numbers: &Vector3<f64>) -> String {
    let [x, y, z] = (*numbers).into();
    format!("({x:.3}, {y:.3}, {z:.3})")
}

/// Returns the findings about these fits, about the sensor's axes each by itself and as one body, and of the whole tensor, the
/// most serious first; includes the unknown scale unless the body has a wheel.
pub fn findings(
    motion: &Motion,
    axes: Option<&AxesFit>,
    body: Option<&TensorFit>,
    tensor: Option<&TensorFit>,
) -> Vec<Finding> {
    let summary = motion.summary();
    let mut found = Vec::new();
    if summary.samples < FEW_SAMPLES {
        found.push(Finding::Short { samples: summary.samples });
    }
    found.extend(wrong_scale(motion).map(|factor| Finding::Scaled { factor }));
    if summary.turn_rad < 1.0 {
        found.push(Finding::Still { turn_rad: summary.turn_rad });
    }
    let noise = 4.0 * motion.noise().max();
    let is_one =
        |[first, next]: [f64; 2]| next <= ONE_AXIS[0] * first || (next <= noise && next <= ONE_AXIS[1] * first);
    if let Some((_, direction)) = motion.turns().filter(|(squares, _)| is_one(*squares)) {
        found.push(Finding::OneAxis { direction });
    }
    if let Some(fit) = axes {
        found.extend(body.and_then(|body| not_free(motion, fit, body)));
        about_axes(fit, &mut found);
    }
    if let Some(fit) = body.filter(|_| motion.has_wheel()) {
        found.extend(not_free_at_all(motion, fit, false));
        found.extend(wheel(fit, false));
    }
    if let Some(fit) = tensor {
        found.extend(not_free_at_all(motion, fit, true));
        found.extend(wheel(fit, true));
        about_tensor(fit, &mut found);
    }
    if summary.pieces < 4 {
        found.push(Finding::FewPieces { pieces: summary.pieces });
    }
    if !motion.has_wheel() {
        found.push(Finding::Scale);
    }
    found
}

/// Returns the factor of all rates, or times, at which the motion is that of a free body, if it is not 1: that of a unit, or the one
/// at which the coefficients' identity holds.
pub fn wrong_scale(motion: &Motion) -> Option<f64> {
    // Rates of 1/k have the coefficients k a, so that a1 + a2 + a3 + a1 a2 a3 / k² = 0 in place of the identity.
    let identity =
        motion.about_known_axes(true).map(|fit| libm::sqrt(-fit.coefficients.product() / fit.coefficients.sum()));
    let identity = identity.filter(|factor| factor.is_finite() && !(1.0 / APART..APART).contains(factor));
    let better = |sums: &Sums, identity: Option<f64>, whole: bool| {
        let noise = motion.noise().sum() * sums.samples as f64 / sums.scatter.diagonal().fixed_rows::<3>(0).sum();
        // Where no body fits at all, everything is unexplained.
        let own = sums.unexplained(whole, 1.0).unwrap_or(1.0);
        let least = |scales: &[f64]| {
            let parts = scales.iter().filter_map(|factor| Some((sums.unexplained(whole, *factor)?, *factor)));
            parts.min_by(|first, second| first.0.total_cmp(&second.0))
        };
        let is_better = |least: f64| own - noise > BETTER * (least - noise).max(0.0) && own > 1.5 * noise;
        let is_wrong = |least: f64| least < WELL && is_better(least);
        let unit = least(&SCALES).filter(|(least, _)| is_wrong(*least));
        let scale = identity
            .and_then(|factor| least(&[factor]))
            .filter(|(least, _)| is_wrong(*least) && own > FAR * least && own > ILL);
        let found = match (unit, scale) {
            // A unit that fits as well is the more likely one.
            (Some(unit), Some(scale)) => Some(if unit.0 < BETTER * scale.0 + noise { unit } else { scale }),
            (unit, scale) => unit.or(scale),
        };
        let (found, factor) = found?;
        // A body with two equal moments has no scale.
        let next = least(&[factor * APART, factor / APART]);
        let alike = next.is_some_and(|(next, _)| next < BETTER * found && next - found < ALIKE * (own - found));
        (!alike).then_some(factor)
    };
    // Whole segments rise above the noise where pieces, short in a wrong unit, do not.
    let sums = [(motion.total(), identity), (Sums { wheel: motion.wheel, ..motion.whole }, None)];
    sums.iter().find_map(|(sums, identity)| [false, true].into_iter().find_map(|whole| better(sums, *identity, whole)))
}

/// Returns true if the motion is that of a body in deg/s or ms too, as with two equal moments.
pub fn has_no_scale(motion: &Motion) -> bool {
    let part = |factor: f64| motion.total().unexplained(false, factor).unwrap_or(1.0);
    let own = BETTER * part(1.0);
    [SCALES[0], SCALES[2]].into_iter().any(|factor| part(factor) < own)
}

/// Returns true if the fit leaves a part of a rate that is neither noise nor negligible.
fn leaves_motion(motion: &Motion, r_squared: &Vector3<f64>) -> bool {
    let (total, noise) = (motion.total(), motion.noise());
    let scatter = total.scatter.diagonal();
    let whole: f64 = scatter.fixed_rows::<3>(0).sum();
    (0..3).any(|axis| {
        let left = (1.0 - r_squared[axis]) * scatter[axis] - 2.0 * noise[axis] * total.samples as f64;
        // Without a rate at all, nothing is left.
        left > (1.0 - EXPLAINED) * scatter[axis] && left > NEGLIGIBLE * whole
    })
}

fn not_free(motion: &Motion, fit: &AxesFit, body: &TensorFit) -> Option<Finding> {
    let certain = fit.deviation.map_or(Vector3::zeros(), |deviation| CERTAIN * deviation);
    let a = &fit.coefficients;
    let closure = fit.closure();
    // Coefficients that the motion does not tell may be any.
    let known = (0..3).all(|axis| is_excited(fit, axis));
    let is_body = nearest_body(&body.moments).is_ok()
        && closure.abs() <= OPEN + certain.norm()
        && (0..3).all(|axis| a[axis].abs() <= 1.0 + OPEN + certain[axis]);
    let explained = !leaves_motion(motion, &fit.r_squared) && !leaves_motion(motion, &body.r_squared);
    (known && !is_body || !explained).then_some(Finding::NotFree {
        whole: false,
        r_squared: fit.r_squared,
        coefficients: *a,
        closure,
        moments: body.moments,
    })
}

fn not_free_at_all(motion: &Motion, fit: &TensorFit, whole: bool) -> Option<Finding> {
    let [x, y, z] = fit.moments.into();
    let coefficients = Vector3::new((y - z) / x, (z - x) / y, (x - y) / z);
    let is_body = fit.distinction < DISTINCT || nearest_body(&fit.moments).is_ok();
    let free = is_body && !leaves_motion(motion, &fit.r_squared);
    (!free).then(|| Finding::NotFree {
        whole,
        r_squared: fit.r_squared,
        coefficients,
        closure: crate::model::closure(&coefficients),
        moments: fit.moments,
    })
}

/// Returns the finding about a body with a wheel.
fn wheel(fit: &TensorFit, whole: bool) -> Option<Finding> {
    let (largest, deviation) = fit.largest?;
    if !whole && fit.distinction < DISTINCT {
        return Some(Finding::Indistinct { whole, distinction: fit.distinction });
    }
    let shown = largest > 0.0 && largest.is_finite() && CERTAIN * deviation.unwrap_or(0.0) < largest;
    (!shown).then_some(Finding::Wheel { whole, largest, deviation })
}

/// Returns true if the motion depends enough on a coefficient.
fn is_excited(fit: &AxesFit, axis: usize) -> bool {
    let known = match fit.deviation {
        Some(deviation) => deviation[axis] < UNKNOWN,
        None => fit.excitation_rad_s[axis] > EXCITED * fit.residual_rad_s[axis],
    };
    fit.excitation_rad_s[axis] > 0.0 && known
}

fn about_axes(fit: &AxesFit, found: &mut Vec<Finding>) {
    let mut excited = [true; 3];
    for (axis, excited) in excited.iter_mut().enumerate() {
        *excited = is_excited(fit, axis);
        if !*excited {
            let (excitation_rad_s, residual_rad_s) = (fit.excitation_rad_s[axis], fit.residual_rad_s[axis]);
            found.push(Finding::Unexcited { axis, excitation_rad_s, residual_rad_s });
        }
    }
    let Some(deviation) = fit.deviation else { return };
    let zero = |axis: usize| fit.coefficients[axis].abs() < CERTAIN * deviation[axis];
    if excited == [true; 3] && (0..3).all(zero) {
        found.push(Finding::Sphere);
        return;
    }
    for axis in (0..3).filter(|axis| excited[*axis]) {
        // A coefficient of zero means that the other two moments are equal.
        if zero(axis) {
            found.push(Finding::Symmetric { axis });
        } else if fit.r_squared[axis] < EXPLAINED {
            found.push(Finding::Unexplained { axis, r_squared: fit.r_squared[axis] });
        }
    }
    // The derivative of the sum with respect to each coefficient.
    let a = &fit.coefficients;
    let slopes = Vector3::new(1.0 + a.y * a.z, 1.0 + a.z * a.x, 1.0 + a.x * a.y);
    let (closure, deviation) = (fit.closure(), slopes.component_mul(&deviation).norm());
    if closure.abs() > CERTAIN * deviation && closure.abs() > 1e-3 {
        found.push(Finding::Open { closure, deviation });
    }
}

fn about_tensor(fit: &TensorFit, found: &mut Vec<Finding>) {
    if fit.distinction < DISTINCT {
        found.push(Finding::Indistinct { whole: true, distinction: fit.distinction });
        return;
    }
    if let Some(deviation_per_s) = fit.damping_deviation_per_s {
        let damping_per_s = fit.damping_per_s;
        if damping_per_s > CERTAIN * deviation_per_s && damping_per_s > 0.0 {
            found.push(Finding::Damped { damping_per_s, deviation_per_s });
        } else if -damping_per_s > CERTAIN * deviation_per_s && damping_per_s < 0.0 {
            found.push(Finding::Driven { growth_per_s: -damping_per_s, deviation_per_s });
        }
    }
    let tilt_rad = fit.tilt_rad().max();
    if tilt_rad > TILTED_RAD {
        found.push(Finding::Tilted { tilt_rad });
    }
}

const _: () = assert!(GROUPS >= 4);
