//! The papers' observers on arrays: inertia, a hidden rate, the laws.

use crate::run::failed;
use corotate::control::{OrbitGains, OrbitHold, Synchronizer};
use corotate::estimate::{FilterKind, Reconstruction, Setup};
use corotate::identify::{Motion, Sample, findings};
use corotate::model::{CentralField, Inertia, OrbitState, RigidBody};
use corotate::nalgebra::Vector3;
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use serde_json::json;

type Column<'py, T> = Bound<'py, PyArray1<T>>;

/// A log as samples, and where a segment ends: before the samples whose label is another. The rate about the axis `hidden` may be
/// unknown.
fn samples(
    time: &PyReadonlyArray1<'_, f64>,
    rates: &PyReadonlyArray2<'_, f64>,
    segments: &PyReadonlyArray1<'_, i64>,
    hidden: Option<usize>,
) -> PyResult<Vec<(bool, Sample)>> {
    let (time, rates, segments) = (time.as_slice()?, rates.as_array(), segments.as_slice()?);
    if rates.shape() != [time.len(), 3] || segments.len() != time.len() {
        let shape = rates.shape();
        return Err(PyValueError::new_err(format!(
            "times are {}, rates {shape:?}: give n times and an (n, 3) array",
            time.len()
        )));
    }
    let mut samples: Vec<(bool, Sample)> = Vec::with_capacity(time.len());
    for index in 0..time.len() {
        let begins = index > 0 && segments[index] != segments[index - 1];
        let rate_rad_s = Vector3::new(rates[[index, 0]], rates[[index, 1]], rates[[index, 2]]);
        let earlier = samples.last().is_some_and(|(_, last)| !begins && time[index] <= last.time_s);
        if !time[index].is_finite() || earlier {
            return Err(PyValueError::new_err(format!(
                "the time of sample {index}, {} s, is not after that of the sample before, or not finite; leave it out, or give \
                 segments",
                time[index]
            )));
        }
        if let Some(axis) = (0..3).find(|axis| Some(*axis + 1) != hidden && !rate_rad_s[*axis].is_finite()) {
            return Err(PyValueError::new_err(format!(
                "the rate about {} of sample {index}, at {} s, is not finite; leave such samples out",
                ["x", "y", "z"][axis],
                time[index]
            )));
        }
        samples.push((begins, Sample { time_s: time[index], rate_rad_s }));
    }
    Ok(samples)
}

/// Identifies a body from a log; returns JSON.
#[pyfunction]
pub fn identify(
    py: Python<'_>,
    time: PyReadonlyArray1<'_, f64>,
    rates: PyReadonlyArray2<'_, f64>,
    segments: PyReadonlyArray1<'_, i64>,
    damping: bool,
) -> PyResult<String> {
    let samples = samples(&time, &rates, &segments, None)?;
    let (value, refusal) = py.detach(|| {
        let mut motion = Motion::default();
        for (begins, sample) in &samples {
            if *begins {
                motion.end_segment();
            }
            motion.push(sample);
        }
        motion.end_segment();
        let (axes, body, tensor) =
            (motion.about_known_axes(damping), motion.moments_about_known_axes(damping), motion.about_unknown_axes(damping));
        let found = findings(&motion, axes.as_ref(), body.as_ref(), tensor.as_ref());
        // As the command, it gives no body that the motion contradicts.
        let refusal = |whole: bool| {
            found.iter().find(|finding| if whole { finding.forbids_tensor() } else { finding.forbids_axes() })
        };
        let (axes_refusal, tensor_refusal) = (refusal(false), refusal(true));
        let (body, tensor) = (body.filter(|_| axes_refusal.is_none()), tensor.filter(|_| tensor_refusal.is_none()));
        let refused = axes_refusal.zip(tensor_refusal).map(|(about_axes, _)| about_axes.to_string());
        let list = |vector: &Vector3<f64>| vector.as_slice().to_vec();
        let value = json!({
            "coefficients": axes.as_ref().map(|fit| list(&fit.coefficients)),
            "coefficients_deviation": axes.as_ref().and_then(|fit| fit.deviation.as_ref().map(list)),
            "closure": axes.as_ref().map(|fit| fit.closure()),
            "r_squared": axes.as_ref().map(|fit| list(&fit.r_squared)),
            "moments": body.as_ref().map(|fit| list(&fit.moments)),
            "moments_deviation": body.as_ref().and_then(|fit| fit.deviation.as_ref().map(list)),
            "damping_per_s": body.as_ref().map(|fit| fit.damping_per_s),
            "tensor_moments": tensor.as_ref().map(|fit| list(&fit.moments)),
            "tensor_deviation": tensor.as_ref().and_then(|fit| fit.deviation.as_ref().map(list)),
            "axes": tensor.as_ref().map(|fit| fit.axes.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>()).collect::<Vec<_>>()),
            "findings": found.iter().map(ToString::to_string).collect::<Vec<_>>(),
        });
        (value, refused)
    });
    match refusal {
        Some(refusal) => Err(PyValueError::new_err(refusal)),
        None => Ok(value.to_string()),
    }
}

/// Estimates the rate about a hidden axis (1 to 3), rad/s, NaN before the first information; and returns whether each step was
/// informative.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "one call from one place")]
pub fn reconstruct<'py>(
    py: Python<'py>,
    time: PyReadonlyArray1<'py, f64>,
    rates: PyReadonlyArray2<'py, f64>,
    segments: PyReadonlyArray1<'py, i64>,
    inertia: [f64; 3],
    hidden: usize,
    filter: &str,
    rate: f64,
    damping_per_s: f64,
    guess: Option<f64>,
    floor_rad_s: f64,
) -> PyResult<(Column<'py, f64>, Column<'py, bool>)> {
    let body = RigidBody::new(&Inertia::new(inertia).map_err(failed)?);
    let filter = match filter {
        "first" => FilterKind::First { decay_per_s: rate },
        "second" => FilterKind::Second { bandwidth_rad_s: rate },
        other => return Err(PyValueError::new_err(format!("there is no filter `{other}`; give first or second"))),
    };
    let setup = Setup {
        coefficients: *body.coefficients(),
        axis: hidden,
        damping_per_s,
        wheel: None,
        filter,
        guess_rad_s: guess,
        floor_rad_s,
    };
    let mut reconstruction = Reconstruction::new(&setup).map_err(|error| PyValueError::new_err(error.to_string()))?;
    let samples = samples(&time, &rates, &segments, Some(hidden))?;
    let (estimates, seen): (Vec<f64>, Vec<bool>) = py.detach(|| {
        let each = samples.iter().map(|(begins, sample)| {
            if *begins {
                reconstruction.end_segment();
            }
            let found = reconstruction.push(sample);
            (found.rate_rad_s, found.observed)
        });
        each.unzip()
    });
    Ok((estimates.into_pyarray(py), seen.into_pyarray(py)))
}

/// The synchronising law's command, rad/s²: of leader and follower, rad/s.
#[pyfunction]
pub fn command(
    inertia: [f64; 3],
    gain_per_s: [f64; 3],
    lead_s: f64,
    leader: [f64; 3],
    follower: [f64; 3],
    applied: [f64; 3],
) -> PyResult<[f64; 3]> {
    let body = RigidBody::new(&Inertia::new(inertia).map_err(failed)?);
    let law = Synchronizer::new(body, gain_per_s.into(), lead_s);
    let (reference, own) = law.ahead(leader.into(), follower.into(), &applied);
    Ok(law.command(&reference, &own).into())
}

/// The orbit law's thrust, du/s²: of the states (r, θ, Vr, Vθ) of a body and of what it is taken to, a circle's radius or a
/// leader's state.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "one call from one place")]
pub fn thrust(
    mu: f64,
    radii: [f64; 2],
    gains: [f64; 3],
    thrust_max: f64,
    lead_s: f64,
    body: [f64; 4],
    target: Vec<f64>,
    applied: [f64; 2],
) -> PyResult<[f64; 2]> {
    let field = CentralField::new(mu, radii[0], radii[1]).map_err(failed)?;
    let [radius_per_s2, radial_per_s, transverse_per_s] = gains;
    let law = OrbitHold::new(field, OrbitGains { radius_per_s2, radial_per_s, transverse_per_s }, thrust_max, lead_s);
    let state = |[r, theta, vr, vtheta]: [f64; 4]| OrbitState { r, vr, theta, vtheta };
    let (body, applied) = (state(body), applied.into());
    let thrust = match (target.as_slice(), <[f64; 4]>::try_from(target.as_slice())) {
        ([radius], _) => law.to_circle(*radius, &body, &applied),
        (_, Ok(leader)) => law.to_leader(&state(leader), &body, &applied),
        (target, _) => {
            let count = target.len();
            return Err(PyValueError::new_err(format!(
                "a target of {count} numbers: give a radius, or (r, theta, vr, vtheta)"
            )));
        }
    };
    Ok(thrust.into())
}
