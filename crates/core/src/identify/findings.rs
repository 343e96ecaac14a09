//! The conclusions from a log about the body, and their limits, as sentences.

use super::motion::{GROUPS, Motion};
use super::{AxesFit, TensorFit};
use nalgebra::Vector3;

/// The number of standard deviations that counts as certain.
const CERTAIN: f64 = 3.0;
/// The part of a rate below which the motion does not obey Euler's equations.
const EXPLAINED: f64 = 0.9;
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
        "the whole tensor is not known by this log: another one fits nearly as well (ratio {distinction:.2}); log a motion \
         about all axes"
    )]
    Indistinct {
        /// The ratio of the fits.
        distinction: f64,
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
            Finding::Unexcited { .. } => "unexcited",
            Finding::Sphere => "sphere",
            Finding::Symmetric { .. } => "symmetric",
            Finding::Damped { .. } => "damped",
            Finding::Driven { .. } => "driven",
            Finding::Unexplained { .. } => "unexplained",
            Finding::Open { .. } => "not-closed",
            Finding::Tilted { .. } => "tilted",
            Finding::Indistinct { .. } => "indistinct",
        }
    }
}

impl Finding {
    /// Returns true if the finding rules out a body about the sensor's axes.
    pub fn forbids_axes(&self) -> bool {
        matches!(self, Self::Short { .. } | Self::Still { .. } | Self::Unexcited { .. })
    }

    /// Returns true if the finding rules out a whole tensor.
    pub fn forbids_tensor(&self) -> bool {
        matches!(self, Self::Short { .. } | Self::Still { .. } | Self::Indistinct { .. })
    }
}

/// Returns the findings about these fits, the most serious first; always includes the unknown scale.
pub fn findings(motion: &Motion, axes: Option<&AxesFit>, tensor: Option<&TensorFit>) -> Vec<Finding> {
    let summary = motion.summary();
    let mut found = Vec::new();
    if summary.samples < FEW_SAMPLES {
        found.push(Finding::Short { samples: summary.samples });
    }
    if summary.turn_rad < 1.0 {
        found.push(Finding::Still { turn_rad: summary.turn_rad });
    }
    if let Some(fit) = axes {
        about_axes(fit, &mut found);
    }
    if let Some(fit) = tensor {
        about_tensor(fit, &mut found);
    }
    if summary.pieces < 4 {
        found.push(Finding::FewPieces { pieces: summary.pieces });
    }
    found.push(Finding::Scale);
    found
}

fn about_axes(fit: &AxesFit, found: &mut Vec<Finding>) {
    let mut excited = [true; 3];
    for (axis, excited) in excited.iter_mut().enumerate() {
        let (excitation_rad_s, residual_rad_s) = (fit.excitation_rad_s[axis], fit.residual_rad_s[axis]);
        let known = match fit.deviation {
            Some(deviation) => deviation[axis] < UNKNOWN,
            None => excitation_rad_s > EXCITED * residual_rad_s,
        };
        *excited = excitation_rad_s > 0.0 && known;
        if !*excited {
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
        found.push(Finding::Indistinct { distinction: fit.distinction });
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
