//! The law of a fleet beside a copy of the same bytes, in one run, taking turns. Run by hand: `cargo bench --bench fleet`.
//!
//! Both read three arrays of f64 and write three others: 48 bytes per follower. What is measured is what the controller of a
//! fleet runs. Compare figures of one run with one another, never with another machine's or another day's.

use corotate::control::{FleetLaw, Synchronizer};
use corotate::model::{Inertia, RigidBody};
use nalgebra::Vector3;
use std::hint::black_box;
use std::time::Instant;

/// Followers per measured turn, at least: long beside a clock read.
const TURN: usize = 200_000;
/// Turns of each kind.
const TURNS: usize = 101;

/// The arrays of a fleet: rates and commands by component.
struct Arrays {
    rates: [Vec<f64>; 3],
    commands: [Vec<f64>; 3],
}

impl Arrays {
    fn new(count: usize) -> Self {
        let rate = |component: usize| (0..count).map(|n| ((n * 3 + component) as f64 * 0.7).sin()).collect();
        Self { rates: [rate(0), rate(1), rate(2)], commands: [(); 3].map(|()| vec![0.0; count]) }
    }

    fn split(&mut self) -> ([&[f64]; 3], [&mut [f64]; 3]) {
        (self.rates.each_ref().map(|rates| &**rates), self.commands.each_mut().map(|commands| &mut **commands))
    }
}

/// Nanoseconds per follower of one turn.
fn turn(arrays: &mut Arrays, mut once: impl FnMut([&[f64]; 3], [&mut [f64]; 3])) -> f64 {
    let count = arrays.rates[0].len();
    let rounds = TURN.div_ceil(count);
    let begun = Instant::now();
    for _ in 0..rounds {
        let (rates, commands) = black_box(&mut *arrays).split();
        once(rates, commands);
    }
    begun.elapsed().as_nanos() as f64 / (rounds * count) as f64
}

fn copy(from: [&[f64]; 3], to: [&mut [f64]; 3]) {
    to.into_iter().zip(from).for_each(|(to, from)| to.copy_from_slice(from));
}

/// The same law follower by follower, as a process with a single one runs it.
fn one_by_one(law: &Synchronizer, reference: &Vector3<f64>, from: [&[f64]; 3], [u1, u2, u3]: [&mut [f64]; 3]) {
    for n in 0..u1.len() {
        let rate = black_box(Vector3::new(from[0][n], from[1][n], from[2][n]));
        let command = law.command(reference, &rate);
        (u1[n], u2[n], u3[n]) = (command.x, command.y, command.z);
    }
}

/// Median and 99th percentile.
fn percentiles(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    [values[values.len() / 2], values[values.len() * 99 / 100]]
}

fn main() {
    let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).expect("a body has such an inertia"));
    let one = Synchronizer::new(body, Vector3::repeat(4.0), 0.0);
    let law = FleetLaw::new(one, 1e3);
    let reference = Vector3::new(0.6, -0.4, 0.8);
    println!("ns per follower, median (99 %) of {TURNS} turns");
    println!("{:>7} {:>16} {:>16} {:>16} {:>7}", "N", "law", "copy", "one by one", "ratio");
    for count in [1, 10, 100, 1000, 10_000, 100_000] {
        let mut arrays = Arrays::new(count);
        let mut figures = [Vec::new(), Vec::new(), Vec::new()];
        for _ in 0..TURNS {
            figures[0].push(turn(&mut arrays, |rates, commands| law.command(&reference, rates, commands)));
            figures[1].push(turn(&mut arrays, copy));
            figures[2].push(turn(&mut arrays, |rates, commands| one_by_one(&one, &reference, rates, commands)));
        }
        let ratios = figures[0].iter().zip(&figures[1]).map(|(law, copy)| law / copy).collect();
        let [ratio, _] = percentiles(ratios);
        let [law, copy, one] = figures.map(percentiles).map(|[median, tail]| format!("{median:.3} ({tail:.3})"));
        println!("{count:>7} {law:>16} {copy:>16} {one:>16} {ratio:>7.2}");
    }
}
