//! The law of a fleet, compared with a copy of the same bytes and with the same law follower by follower.
//!
//! All of them read three arrays of f64 and write three others: 48 bytes per follower. The measured code is that of a
//! fleet's controller. The largest fleets exceed the caches, so that the copy measures the memory's bandwidth.

use corotate::bench::{Bench, BenchError, Board};
use corotate::control::{FleetLaw, Synchronizer};
use corotate::model::{Inertia, RigidBody};
use nalgebra::Vector3;
use std::hint::black_box;
use std::time::Instant;

/// The numbers of followers.
const COUNTS: [usize; 6] = [1, 10, 100, 1000, 10_000, 100_000];
/// The bytes per follower: rates in, commands out.
const BYTES: f64 = 48.0;

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

    /// Returns the nanoseconds per follower over rounds with at least `followers` followers in total.
    fn turn(&mut self, followers: usize, mut once: impl FnMut([&[f64]; 3], [&mut [f64]; 3])) -> f64 {
        let count = self.rates[0].len();
        let rounds = followers.div_ceil(count);
        let began = Instant::now();
        for _ in 0..rounds {
            let (rates, commands) = black_box(&mut *self).split();
            once(rates, commands);
        }
        began.elapsed().as_nanos() as f64 / (rounds * count) as f64
    }
}

fn copy(from: [&[f64]; 3], to: [&mut [f64]; 3]) {
    to.into_iter().zip(from).for_each(|(to, from)| to.copy_from_slice(from));
}

/// Computes the same law follower by follower, like a controller of single followers.
fn one_by_one(law: &Synchronizer, reference: &Vector3<f64>, from: [&[f64]; 3], [u1, u2, u3]: [&mut [f64]; 3]) {
    for n in 0..u1.len() {
        let rate = black_box(Vector3::new(from[0][n], from[1][n], from[2][n]));
        let command = law.command(reference, &rate);
        (u1[n], u2[n], u3[n]) = (command.x, command.y, command.z);
    }
}

/// Measures the row.
pub fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, followers) = (bench.size(41, 3), bench.size(200_000, 2000));
    let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).expect("a body has such an inertia"));
    let single_law = Synchronizer::new(body, Vector3::repeat(4.0), 0.0);
    let law = FleetLaw::new(single_law, 1e3);
    let reference = Vector3::new(0.6, -0.4, 0.8);
    for count in COUNTS {
        bench.next(&format!("fleet: {count} followers"))?;
        let mut arrays = Arrays::new(count);
        let floor = format!("copy, N = {count}");
        for _ in 0..rounds {
            // In the leader's place, so that other work of the machine is not measured too.
            let [ours, copied, single] = bench.in_the_leaders_place(board, |_| {
                Ok([
                    arrays.turn(followers, |rates, commands| law.command(&reference, rates, commands)),
                    arrays.turn(followers, copy),
                    arrays.turn(followers, |rates, commands| one_by_one(&single_law, &reference, rates, commands)),
                ])
            })?;
            board.add(&format!("law, N = {count}"), "ns", Some(&floor), ours);
            board.add(&floor, "ns", None, copied);
            board.add(&format!("bandwidth of the copy, N = {count}"), "GB/s", None, BYTES / copied);
            board.add(&format!("law one by one, N = {count}"), "ns", Some(&floor), single);
        }
    }
    Ok(())
}
