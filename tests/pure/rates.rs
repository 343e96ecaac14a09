//! Controllers and observers that compute at every n-th tick only, against an implementation that shares no code with them.

use super::reference_loop::{TOLERANCE, columns};
use crate::common::{reference, shipped};
use corotate::scenario::{Scenario, claims};

/// `rigid-pair` at 100 Hz with these rates.
fn pair(controller_ticks: u64, observer_ticks: u64, overrides: &[String]) -> Scenario {
    let rates = [
        format!("controller.every_ticks={controller_ticks}"),
        format!("observer.every_ticks={observer_ticks}"),
        "tick_hz=100".to_owned(),
        "accept={}".to_owned(),
    ];
    Scenario::load(&shipped("rigid-pair"), &[&rates, overrides].concat()).unwrap()
}

#[test]
fn the_loop_follows_the_reference_at_every_rate() {
    let rows = reference("let_pair_rates_100hz.csv");
    let (mut worst, mut cases) = (0.0_f64, 0);
    for case in rows.chunk_by(|a, b| a[..2] == b[..2]) {
        let overrides = ["observer.decay_rate_per_s=5.0", "controller.gain_per_s=[2.0, 2.0, 2.0]", "duration_s=4.0"];
        let found = columns(&pair(case[0][0] as u64, case[0][1] as u64, &overrides.map(str::to_owned)));
        for expected in case {
            let row = &found[expected[2] as usize];
            for (value, expected) in row.iter().zip(&expected[2..]) {
                worst = worst.max((value - expected).abs());
            }
        }
        cases += 1;
        println!("{:?}: worst deviation so far {worst:e}", &case[0][..2]);
    }
    assert_eq!(cases, 8);
    assert!(worst <= TOLERANCE, "{worst:e}");
}

/// The override for sensors of the rates of both bodies, each at every n-th tick from a phase on.
fn sensors(leader: [u64; 2], follower: [u64; 2]) -> String {
    let sensor = |body: &str, [every, phase]: [u64; 2]| {
        format!("{{body=\"{body}\",field=\"omega_rad_s\",every_ticks={every},phase_ticks={phase}}}")
    };
    format!("sensor=[{},{}]", sensor("leader", leader), sensor("follower", follower))
}

/// While the leader's sensor has no new value the estimate advances by its equations; the law uses the follower's held rate.
#[test]
fn the_loop_follows_the_reference_with_slower_sensors() {
    let rows = reference("let_pair_sensors_100hz.csv");
    let (mut worst, mut cases) = (0.0_f64, 0);
    for case in rows.chunk_by(|a, b| a[..6] == b[..6]) {
        let [leader, leader_phase, follower, follower_phase, controller, observer] =
            <[f64; 6]>::try_from(&case[0][..6]).unwrap().map(|ticks| ticks as u64);
        let overrides = ["observer.decay_rate_per_s=5.0", "controller.gain_per_s=[2.0, 2.0, 2.0]", "duration_s=4.0"];
        let mut overrides: Vec<String> = overrides.map(str::to_owned).into();
        overrides.push(sensors([leader, leader_phase], [follower, follower_phase]));
        let found = columns(&pair(controller, observer, &overrides));
        for expected in case {
            let row = &found[expected[6] as usize];
            for (value, expected) in row.iter().zip(&expected[6..]) {
                worst = worst.max((value - expected).abs());
            }
        }
        cases += 1;
        println!("{:?}: worst deviation so far {worst:e}", &case[0][..6]);
    }
    assert_eq!(cases, 5);
    assert!(worst <= TOLERANCE, "{worst:e}");
}

/// The error of a run falls at the claimed rate. A controller that is faster than its own body's sensor would compare new estimates with
/// an old measurement, and leave a high floor.
#[test]
fn the_claimed_rate_is_observed_with_slower_sensors() {
    for (gain, decay, leader, follower, controller_ticks) in [
        (12.0, 60.0, [5, 0], [5, 0], 5),
        (10.0, 200.0, [1, 0], [5, 0], 5),
        (8.0, 3.0, [10, 3], [1, 0], 1),
        (9.0, 40.0, [3, 1], [2, 0], 2),
    ] {
        let overrides = [
            format!("controller.gain_per_s={:?}", [gain; 3]),
            format!("observer.decay_rate_per_s={decay:?}"),
            sensors(leader, follower),
        ];
        let scenario = pair(controller_ticks, 1, &overrides);
        let claim = claims(&scenario).remove(0);
        let claimed = claim.loop_rate_per_s.unwrap_or(f64::NAN);
        let (observed, ticks) = observed_rate(&columns(&scenario));
        println!(
            "{leader:?}, {follower:?}: claimed {claimed:.4}, observed {observed:.4} over {ticks} ticks; {:?}",
            claim.reason
        );
        assert!((observed / claimed - 1.0).abs() < 0.05, "{observed} is not {claimed}");
        assert_eq!(claim.continuous_rate_per_s, None);
    }
}

/// Rates from an independent program: the product of the one-tick transitions of (e, the acting command, the last one, the held and
/// the present error of the estimate), linearised about the leader's motion by its variational equation. The error of a run must fall
/// at the claimed rate too.
#[test]
fn the_claimed_rate_is_that_of_the_slower_loop() {
    for (gain, decay, controller_ticks, observer_ticks, expected) in [
        (50.0, 200.0, 1, 1, 34.5445),
        (20.0, 200.0, 2, 1, 39.2912),
        (10.0, 200.0, 5, 1, 21.2601),
        (12.0, 60.0, 5, 5, 20.5570),
        (8.0, 3.0, 10, 1, 3.0),
        (8.0, 20.0, 10, 5, 12.1378),
        (30.0, 200.0, 3, 1, 19.9405),
        (9.0, 40.0, 3, 2, 12.4005),
    ] {
        let overrides =
            [format!("controller.gain_per_s={:?}", [gain; 3]), format!("observer.decay_rate_per_s={decay:?}")];
        let scenario = pair(controller_ticks, observer_ticks, &overrides);
        let claim = claims(&scenario).remove(0);
        let claimed = claim.loop_rate_per_s.unwrap_or(f64::NAN);
        let (observed, ticks) = observed_rate(&columns(&scenario));
        println!(
            "{controller_ticks}, {observer_ticks}: claimed {claimed:.4}, expected {expected}, observed {observed:.4} over {ticks} \
             ticks; {:?}",
            claim.reason
        );
        assert!((claimed / expected - 1.0).abs() < 0.03, "{claimed} is not {expected}");
        // The controller uses estimates that are a tick old: their error is a high floor.
        let old = controller_ticks % observer_ticks != 0;
        assert!(old || (observed / claimed - 1.0).abs() < 0.05, "{observed} is not {claimed}");
        assert_eq!(claim.continuous_rate_per_s.is_some(), (controller_ticks, observer_ticks) == (1, 1));
    }
}

/// Returns the rate at which the follower's error falls, 1/s, and the number of ticks used: a least-squares line through the logarithm
/// of the error, after the first e-foldings and above rounding.
fn observed_rate(rows: &[Vec<f64>]) -> (f64, usize) {
    let error = |row: &Vec<f64>| (2..5).map(|axis| (row[axis] - row[axis + 3]).powi(2)).sum::<f64>().sqrt();
    let fall: Vec<(f64, f64)> = rows.iter().map(|row| (row[1], error(row))).collect();
    let start = fall[0].1;
    let floor = fall[fall.len() * 3 / 4..].iter().fold(0.0_f64, |floor, (_, error)| floor.max(*error));
    let part: Vec<(f64, f64)> = fall
        .iter()
        .skip_while(|(_, error)| *error > 1e-2 * start)
        .take_while(|(_, error)| *error > (10.0 * floor).max(1e-10))
        .map(|(time_s, error)| (*time_s, error.ln()))
        .collect();
    (-slope(&part), part.len())
}

fn slope(points: &[(f64, f64)]) -> f64 {
    let count = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0 / count, y + point.1 / count));
    let (xy, xx) = points
        .iter()
        .fold((0.0, 0.0), |(xy, xx), point| (xy + (point.0 - x) * (point.1 - y), xx + (point.0 - x).powi(2)));
    xy / xx
}
