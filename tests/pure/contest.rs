//! The contest of `benches/contest` runs, and its contestants compute the same results. No figure is checked: a smoke
//! run on a loaded machine measures nothing.

use crate::contestants::ROWS;
use crate::contestants::compiled::NATIVE;
use crate::contestants::step::{agreements, library};
use corotate::bench::{Bench, Results, run};
use corotate::config::SHIPPED;
use std::sync::atomic::AtomicUsize;
use std::time::SystemTime;

#[test]
fn the_step_and_the_fleet_are_compared_with_all_their_floors() {
    let mut bench = Bench {
        rows: ROWS.to_vec(),
        quick: true,
        scenarios: &SHIPPED,
        signal: &AtomicUsize::new(0),
        progress: &mut |_| {},
    };
    let (board, privileges) = run(&mut bench).unwrap();
    let results = Results::new(&bench, board, privileges, SystemTime::now());
    let has = |row: &str, name: &str| results.figures.iter().any(|figure| figure.row == row && figure.name == name);
    for name in ["first order", "second order", "identifier", "orbit"] {
        for suffix in ["", " in C", " in C, for any machine"] {
            assert!(has("step", &format!("{name}{suffix}")), "{name}{suffix}");
        }
    }
    for name in ["bare copy of its samples", "step of rigid-trio", "filter alone, elliptic: guarded Kalman"] {
        assert!(has("step", name), "{name}");
    }
    for count in [1, 10, 100, 1000, 10_000, 100_000] {
        assert!(has("fleet", &format!("law, N = {count}")) && has("fleet", &format!("copy, N = {count}")), "{count}");
    }
    for figure in &results.figures {
        assert!(figure.rounds.len() == 3 && figure.rounds.iter().all(|round| *round > 0.0), "{figure:?}");
    }
    // Every target has its measurement; a smoke run checks none.
    assert_eq!(results.targets.len(), 6);
    assert!(
        results.targets.iter().all(|target| target.value.is_some() && target.met.is_none()),
        "{:?}",
        results.targets
    );
}

#[test]
fn the_code_in_c_computes_the_same_numbers() {
    let agreements = agreements(&library(NATIVE)).unwrap();
    assert_eq!(agreements.len(), 4);
    for agreement in agreements {
        assert!(agreement.words && agreement.largest < 1e-12, "{agreement:?}");
    }
}
