//! Reads and checks the tables of this rig, and designs observer, law and limits from them.
//!
//! Every refusal names the key and the remedy, and all refusals are reported at once.

use super::config::{self, Coefficients, IdentifierDecay, Kind, Raw, RawLeader, RawObserver};
use super::design::{ControllerDesign, ObserverDesign, RigidBodyRig};
use super::limits::{Circumstances, Limits};
use super::plant::Outage;
use super::playback::{self, Playback};
use crate::config::{Checks, ConfigError, Document};
use crate::model::{Inertia, Noise};
use crate::observe::{AxisymmetricRelation, Filter, HiddenRate, Hurwitz, InertiaRelation, InvariantFilter};
use crate::rate::{Identifier, LearnerDesign};
use crate::rig::BodyInfo;
use crate::rig::contract::Context;
use crate::rig::filter::{FilterDesign, SURE_DEVIATIONS, UNKNOWN_DEVIATION};
use nalgebra::{Matrix3, Vector1, Vector3};
use std::sync::Arc;

/// The largest part of the leader's rate by which rounding may move the hidden component's estimate. Beyond it the estimate has
/// fewer than three digits and is refused. A floor between this and the usual one is reported with the loop's claim.
const LARGEST_ROUNDING: f64 = 1e-3;

/// Reads and checks the tables of this rig.
pub(super) fn resolve(
    sections: &Document,
    context: Context,
    checks: &mut Checks<'_>,
) -> Result<(Option<RigidBodyRig>, toml::Table), ConfigError> {
    let mut raw: Raw = sections.read_into()?;
    config::check(&raw, checks);
    let mut notes = Vec::new();
    let playback = load_playback(&mut raw.leader, context, &mut notes, checks);
    let table = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
    if raw.leader.data.is_some() {
        let Some(playback) = &playback else { return Ok((None, table)) };
        raw.leader.initial_rate_rad_s = Some(playback.at(0.0).into());
    }
    notes.extend(unmeasured(&raw.leader));
    let supplied_axis = config::hidden_axis(&raw, checks);
    let outages = resolve_outages(&raw, context.tick_s, checks);
    let inertia = checks.accept("leader.inertia_kg_m2", Inertia::new(raw.leader.inertia_kg_m2));
    let Some(inertia) = inertia else { return Ok((None, table)) };
    let observer = design_observer(&raw, &inertia, supplied_axis, context.tick_s, &mut notes, checks);
    let Some(observer) = observer else { return Ok((None, table)) };
    let mut rig = RigidBodyRig {
        bodies: vec![BodyInfo::free("leader")],
        inertia,
        spreads: vec![Vector3::zeros()],
        seed: context.seed,
        initial_rates: vec![raw.leader.initial()],
        inertia_factors: vec![Vector3::repeat(1.0)],
        measured: (0..3).filter(|i| raw.leader.measured_axes.contains(&(i + 1))).fold(0, |bits, i| bits | 1 << i),
        outages,
        supplied_axis,
        observer,
        controller: raw.controller.as_ref().map(ControllerDesign::from),
        noise: vec![noise(context, 0, raw.leader.noise_rad_s, raw.leader.bias_rad_s)],
        deviations_rad_s: vec![raw.leader.noise_rad_s.into()],
        biases_rad_s: vec![raw.leader.bias_rad_s.into()],
        offsets_rad_s: vec![Vector3::zeros()],
        disturbances_rad_s2: vec![raw.leader.disturbance_rad_s2.into()],
        limits: design_limits(
            &raw,
            leader_bound_rad_s(&raw.leader, &inertia, playback.as_deref()),
            supplied_axis,
            checks,
        ),
        playback,
        notes,
        tick_s: context.tick_s,
        actuation_delay_ticks: context.actuation_delay_ticks,
        rates: context.rates,
        certificate: None,
    };
    rig.certificate = rig.certify();
    for (index, follower) in raw.follower.into_iter().enumerate() {
        let factor = Vector3::from(follower.inertia_factor);
        let own = inertia.moments_kg_m2().component_mul(&factor);
        checks.accept(&format!("follower[{index}].inertia_factor"), Inertia::new(own.into()));
        rig.initial_rates.push(follower.initial_rate_rad_s.into());
        rig.spreads.push(follower.spread_rad_s().into());
        let (fleet, name) = (follower.fleet(), follower.name.into());
        rig.bodies.push(BodyInfo { name, driven: true, fleet, observer: None });
        rig.inertia_factors.push(factor);
        rig.noise.push(noise(context, index as u64 + 1, follower.noise_rad_s, follower.bias_rad_s));
        rig.deviations_rad_s.push(follower.noise_rad_s.into());
        rig.biases_rad_s.push(follower.bias_rad_s.into());
        rig.offsets_rad_s.push(follower.offset_rad_s.into());
        rig.disturbances_rad_s2.push(follower.disturbance_rad_s2.into());
    }
    rig.check_tick(checks);
    Ok((Some(rig), table))
}

/// Returns warnings about settings of axes that the leader does not measure: they have no effect.
fn unmeasured(leader: &RawLeader) -> impl Iterator<Item = String> {
    let warnings = |key: &'static str, values: [f64; 3]| {
        let measured = &leader.measured_axes;
        (1..=3).filter(move |axis| values[axis - 1] != 0.0 && !measured.contains(axis)).map(move |axis| {
            format!("leader.{key} is set for axis {axis}, which is not measured: it has no effect there")
        })
    };
    warnings("noise_rad_s", leader.noise_rad_s).chain(warnings("bias_rad_s", leader.bias_rad_s))
}

fn noise(context: Context, stream: u64, deviation: [f64; 3], bias: [f64; 3]) -> Noise<3> {
    Noise::new(context.seed, stream, deviation, bias)
}

impl From<&config::RawController> for ControllerDesign {
    fn from(raw: &config::RawController) -> Self {
        Self {
            gain_per_s: raw.gain_per_s.into(),
            predict: raw.predict,
            learned: raw.coefficients == Coefficients::Learned,
            adaptation_gain: raw.adaptation_gain,
        }
    }
}

fn resolve_outages(raw: &Raw, tick_s: f64, checks: &mut Checks<'_>) -> Vec<Outage> {
    let mut outages = Vec::new();
    for (index, outage) in raw.leader.outage.iter().enumerate() {
        let key = |name: &str| format!("leader.outage[{index}].{name}");
        let known = raw.leader.measured_axes.contains(&outage.axis) && (1..=3).contains(&outage.axis);
        checks.require(known, &key("axis"), "no-such-axis", || {
            format!("axis {} has no gyro to fail; name one of leader.measured_axes", outage.axis)
        });
        checks.require(outage.from_s >= 0.0, &key("from_s"), "negative", || {
            format!("{} is before the start; give 0 or more", outage.from_s)
        });
        let until_s = outage.until_s.unwrap_or(f64::INFINITY);
        checks.require(until_s > outage.from_s, &key("until_s"), "wrong-order", || {
            format!("{until_s} is not after from_s; raise it")
        });
        let tick = |time_s: f64| (time_s / tick_s).round() as u64;
        if known {
            outages.push(Outage {
                component: outage.axis - 1,
                from_tick: tick(outage.from_s),
                until_tick: tick(until_s),
            });
        }
    }
    outages
}

/// Returns a bound on the leader's rate, rad/s.
fn leader_bound_rad_s(leader: &RawLeader, inertia: &Inertia, playback: Option<&Playback>) -> f64 {
    playback.map_or_else(|| inertia.rate_bound_rad_s(&leader.initial()), |playback| playback.bounds().0)
}

/// Loads the motion that the leader plays back, if any, and records its file and the hash of its samples in the scenario.
fn load_playback(
    leader: &mut RawLeader,
    context: Context,
    notes: &mut Vec<String>,
    checks: &mut Checks<'_>,
) -> Option<Arc<Playback>> {
    let path = playback::locate(checks.file("leader.data", leader.data.as_ref()?));
    let mut raw = leader.playback.take().unwrap_or_default();
    leader.data = Some(path.display().to_string());
    let playback = checks.accept("leader.data", raw.load(&path, context.duration_s))?;
    let (samples, longest_s) = playback.sampling();
    checks.require(playback.repeats() || context.duration_s <= playback.length_s(), "duration_s", "log-too-short", || {
        format!(
            "{} s is longer than the motion of leader.data, {} s; lower it, or give leader.playback.at_end = \"repeat\"",
            context.duration_s,
            playback.length_s()
        )
    });
    notes.push(format!(
        "leader.data: the motion of {samples} samples over {:.6} s, at most {longest_s:.6} s apart, joined by cubics (Hermite)",
        playback.length_s()
    ));
    notes.extend(playback.assumed().map(|assumed| format!("leader.data: {assumed}")));
    if let Some(error) = playback.coarse_error_rad_s() {
        notes.push(format!(
            "leader.data: cubics through every second sample miss the other samples by at most {error:.3e} rad/s, noise included"
        ));
    }
    raw.hash = Some(playback.hash());
    leader.playback = Some(raw);
    Some(Arc::new(playback))
}

fn design_limits(raw: &Raw, leader_rad_s: f64, hidden: Option<usize>, checks: &mut Checks<'_>) -> Limits {
    let fastest =
        |rates: &mut dyn Iterator<Item = [f64; 3]>| rates.map(|rate| Vector3::from(rate).norm()).fold(0.0, f64::max);
    let recorded = raw.leader.data.is_some();
    let noisy = raw.leader.noise_rad_s != [0.0; 3] || recorded || raw.observer.decay_rate_per_s.is_none();
    let gain_per_s = raw.controller.as_ref().map_or(0.0, |controller| Vector3::from(controller.gain_per_s).amax());
    let about = Circumstances {
        leader_rad_s,
        follower_rad_s: fastest(&mut raw.follower.iter().map(|follower| follower.fastest().into())),
        guess_error_rad_s: hidden
            .map_or(0.0, |axis| (raw.observer.initial_guess_rad_s - raw.leader.initial()[axis - 1]).abs()),
        transient_rad_s: raw.observer.initial_guess_rad_s.abs()
            + if noisy { SURE_DEVIATIONS * UNKNOWN_DEVIATION } else { 0.0 },
        // The filter follows a reconstruction that divides noise by the tick. Without noise the reconstruction is exact.
        correction_per_s: match raw.observer.decay_rate_per_s {
            Some(decay) if !noisy && raw.observer.kind == Kind::HiddenRate => decay,
            _ => f64::INFINITY,
        },
        gain_per_s,
    };
    Limits::resolve(&raw.limits, &about, checks)
}

fn design_observer(
    raw: &Raw,
    inertia: &Inertia,
    supplied_axis: Option<usize>,
    tick_s: f64,
    notes: &mut Vec<String>,
    checks: &mut Checks<'_>,
) -> Option<ObserverDesign> {
    let (observer, coefficients) = (&raw.observer, inertia.coefficients());
    let floor_rad_s = observer.observability_floor_rad_s;
    if let Some(axis) = supplied_axis {
        // Observability depends on the true body, even if the observer must learn it.
        let relation = checks.accept("leader.inertia_kg_m2", HiddenRate::new(&coefficients, axis, floor_rad_s))?;
        check_digits(&relation, inertia, &raw.leader.initial(), tick_s, checks);
    }
    let filter = FilterDesign::resolve(
        checks,
        observer.decay_rate_per_s.map(|rate| [rate]),
        observer.bandwidth_rad_s.map(|bandwidth| [bandwidth]),
        ("process_noise_rad2_s3", observer.process_noise_rad2_s3),
    )?;
    if let FilterDesign::Kalman(_) = filter {
        let noisy = |axis: &usize| raw.leader.noise_rad_s.get(axis.wrapping_sub(1)).is_some_and(|noise| *noise > 0.0);
        checks.require(
            raw.leader.measured_axes.iter().all(noisy),
            "observer.process_noise_rad2_s3",
            "no-noise",
            || {
                "needs sensor noise, and leader.noise_rad_s is 0 on a measured axis; give it, or choose another filter"
                    .to_owned()
            },
        );
    }
    match observer.kind {
        Kind::HiddenRate => Some(ObserverDesign::Hidden {
            relation: HiddenRate::new(&coefficients, supplied_axis?, floor_rad_s).ok()?,
            filter,
            guess_rad_s: observer.initial_guess_rad_s,
        }),
        Kind::Inertia | Kind::AxisymmetricInertia => {
            let FilterDesign::First([decay_rate_per_s]) = filter else {
                checks.refuse(
                    "observer.kind",
                    "wrong-filter",
                    "needs a first-order filter to learn; give observer.decay_rate_per_s instead",
                );
                return None;
            };
            let identifier = design_identifier(&raw.leader, observer, inertia, notes, checks)?;
            Some(ObserverDesign::Learner(LearnerDesign { identifier, decay_rate_per_s, floor_rad_s }))
        }
    }
}

/// Checks that rounding leaves enough digits of the hidden component. A body with nearly equal moments keeps its initial rates
/// for the whole run, so they represent its motion. If they carry no information at all, the cause is the motion and not the
/// body, and the analysis of the loop reports it.
fn check_digits(
    relation: &HiddenRate,
    inertia: &Inertia,
    rate_rad_s: &Vector3<f64>,
    tick_s: f64,
    checks: &mut Checks<'_>,
) {
    let part = relation.rounding_rad_s(rate_rad_s, tick_s) / inertia.rate_bound_rad_s(rate_rad_s);
    let (axis, lacking) = (relation.hidden() + 1, part / LARGEST_ROUNDING);
    checks.require(!(lacking > 1.0 && lacking.is_finite()), "leader.inertia_kg_m2", "unobservable-axis", || {
        format!(
            "axis {axis} cannot be observed: the moments are so nearly equal that in a tick of {tick_s} s the hidden \
             component hardly changes the measured ones by more than their rounding, which may move the estimate by {part:.1e} \
             of the leader's rate; give moments whose differences are at least {:.0} times as large, or lower tick_hz \
             as many times",
            lacking.ceil()
        )
    });
}

fn design_identifier(
    leader: &RawLeader,
    observer: &RawObserver,
    inertia: &Inertia,
    notes: &mut Vec<String>,
    checks: &mut Checks<'_>,
) -> Option<Identifier> {
    let floor_rad_s = observer.observability_floor_rad_s;
    let guess = observer.initial_coefficients;
    if observer.kind == Kind::AxisymmetricInertia {
        let axis = observer.symmetry_axis?;
        check_symmetry(leader, inertia, axis, floor_rad_s, checks);
        let relation = checks.accept("observer.symmetry_axis", AxisymmetricRelation::new(axis, floor_rad_s))?;
        let design = match (&observer.identifier_decay, observer.identifier_bandwidth) {
            (Some(IdentifierDecay::Rates(rates)), _) => FilterDesign::First([rates[0]]),
            (_, Some(bandwidth)) => FilterDesign::Second([bandwidth[0]]),
            _ => {
                let key = "observer.identifier_decay";
                checks.refuse(key, "not-a-matrix", "is a matrix, but there is one unknown; give three equal rates");
                return None;
            }
        };
        let [slowest] = design.decay_rates()?;
        let filter = design.filter(Vector1::new(guess[axis % 3]));
        return Some(Identifier::axisymmetric(relation, axis, filter, slowest));
    }
    let (filter, slowest) = match (&observer.identifier_decay, observer.identifier_bandwidth) {
        (Some(decay), _) => {
            let matrix = match decay {
                IdentifierDecay::Rates(rates) => Matrix3::from_diagonal(&-Vector3::from(*rates)),
                IdentifierDecay::Matrix(rows) => Matrix3::from_fn(|row, column| rows[row][column]),
            };
            let matrix = checks.accept("observer.identifier_decay", Hurwitz::new(matrix))?;
            notes.push(format!("observer.identifier_decay: eigenvalues {}", matrix.eigenvalues()));
            (Filter::First(InvariantFilter::with_matrix(matrix, guess.into())), -matrix.abscissa())
        }
        (None, bandwidth) => {
            let design = FilterDesign::Second(bandwidth?);
            let slowest = design.decay_rates()?.into_iter().fold(f64::INFINITY, f64::min);
            (design.filter(guess.into()), slowest)
        }
    };
    let relation = InertiaRelation::new(floor_rad_s * floor_rad_s * floor_rad_s);
    Some(Identifier::asymmetric(relation, filter, slowest))
}

/// Checks that a body declared as axisymmetric is so, and that it spins.
fn check_symmetry(leader: &RawLeader, inertia: &Inertia, axis: usize, floor_rad_s: f64, checks: &mut Checks<'_>) {
    if !(1..=3).contains(&axis) {
        return;
    }
    let (spin_rad_s, moments) = (leader.initial()[axis - 1], inertia.moments_kg_m2());
    checks.require(spin_rad_s.abs() > floor_rad_s, "leader.initial_rate_rad_s", "no-spin", || {
        format!(
            "the body never spins about its symmetry axis {axis} ({spin_rad_s} rad/s), so its motion carries \
             no information on its inertia; give component {axis} a rate"
        )
    });
    checks.require(moments[axis % 3] == moments[(axis + 1) % 3], "leader.inertia_kg_m2", "not-symmetric", || {
        format!("the moments about the axes other than {axis} differ; use observer.kind = \"inertia\" for this body")
    });
}
