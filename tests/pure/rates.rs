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
        let rows = columns(&scenario);
        let error = |row: &Vec<f64>| (2..5).map(|axis| (row[axis] - row[axis + 3]).powi(2)).sum::<f64>().sqrt();
        // A least-squares line through the logarithm of the error, after the first e-foldings and above rounding.
        let fall: Vec<(f64, f64)> = rows.iter().map(|row| (row[1], error(row))).collect();
        let start = fall[0].1;
        let floor = fall[fall.len() * 3 / 4..].iter().fold(0.0_f64, |floor, (_, error)| floor.max(*error));
        let part: Vec<(f64, f64)> = fall
            .iter()
            .skip_while(|(_, error)| *error > 1e-2 * start)
            .take_while(|(_, error)| *error > (10.0 * floor).max(1e-10))
            .map(|(time_s, error)| (*time_s, error.ln()))
            .collect();
        let observed = -slope(&part);
        println!(
            "{controller_ticks}, {observer_ticks}: claimed {claimed:.4}, expected {expected}, observed {observed:.4} over {} \
             ticks; {:?}",
            part.len(),
            claim.reason
        );
        assert!((claimed / expected - 1.0).abs() < 0.03, "{claimed} is not {expected}");
        // The controller uses estimates that are a tick old: their error is a high floor.
        let old = controller_ticks % observer_ticks != 0;
        assert!(old || (observed / claimed - 1.0).abs() < 0.05, "{observed} is not {claimed}");
        assert_eq!(claim.continuous_rate_per_s.is_some(), (controller_ticks, observer_ticks) == (1, 1));
    }
}

fn slope(points: &[(f64, f64)]) -> f64 {
    let count = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0 / count, y + point.1 / count));
    let (xy, xx) = points
        .iter()
        .fold((0.0, 0.0), |(xy, xx), point| (xy + (point.0 - x) * (point.1 - y), xx + (point.0 - x).powi(2)));
    xy / xx
}
