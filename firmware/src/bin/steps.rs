//! How many instructions a step takes, for a machine on which one instruction takes one nanosecond (`-icount shift=0`).
//!
//! Prints a line per step to the UART. The loop is that of `config/rigid-pair.toml`, its bodies simulated here too.

#![no_std]
#![no_main]

use core::fmt::{self, Write};
use core::hint::black_box;
use corotate::model::RigidBody;
use corotate::role::{Controller, Observer};
use corotate::sample::{RateCommand, RateEstimate, RateMeasurement};
use corotate_firmware::board::Board;
use corotate_firmware::{halt, pair};
use cortex_m::peripheral::SYST;
use cortex_m_rt::entry;
use nalgebra::Vector3;

/// The period h, s, and how many ticks are measured: the first few are no usual ones.
const TICK_S: f64 = 0.001;
const TICKS: u64 = 1100;
const FIRST: u64 = 100;
/// Instructions per count of the clock: at 25 MHz and one instruction per nanosecond.
const PER_COUNT: u32 = 40;
/// The clock counts down from here, without an interrupt: no step takes so long.
const RELOAD: u32 = 0x00ff_ffff;

struct Text<'a>(&'a mut Board);

impl Write for Text<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.write(text.as_bytes());
        Ok(())
    }
}

/// The instructions of many steps, in counts of the clock.
#[derive(Default)]
struct Counted(u32);

impl Counted {
    fn time<T>(&mut self, counts: bool, step: impl FnOnce() -> T) -> T {
        let from = SYST::get_current();
        let made = black_box(step());
        let took = from.wrapping_sub(SYST::get_current()) & RELOAD;
        self.0 += if counts { took } else { 0 };
        made
    }

    /// Instructions per step, beyond those that measuring takes.
    fn mean(&self, measuring: &Self) -> u32 {
        self.0.saturating_sub(measuring.0) * PER_COUNT / (TICKS - FIRST) as u32
    }
}

fn measurement(tick: u64, rate: &Vector3<f64>, applied: &Vector3<f64>, valid: u64) -> RateMeasurement {
    let mut measurement = RateMeasurement::default();
    measurement.stamp.tick = tick;
    (measurement.omega_rad_s, measurement.applied_rad_s2) = ((*rate).into(), (*applied).into());
    measurement.valid = valid;
    measurement
}

fn run(board: &mut Board) -> Option<()> {
    let body = RigidBody::new(&pair::inertia()?);
    let (mut leader, mut follower) = (Vector3::from(pair::LEADER_RATE_RAD_S), Vector3::from(pair::FOLLOWER_RATE_RAD_S));
    let mut observer = Observer::new(pair::observer()?, TICK_S);
    let mut controller = Controller::new(pair::law(TICK_S)?);
    let (mut estimate, mut command) = (RateEstimate::default(), RateCommand::default());
    let (mut observing, mut controlling, mut moving, mut measuring) =
        (Counted::default(), Counted::default(), Counted::default(), Counted::default());
    for tick in 0..TICKS {
        let counts = tick >= FIRST;
        let seen = [leader.x, leader.y, 0.0].into();
        let of_leader = black_box(measurement(tick, &seen, &Vector3::zeros(), 0b011));
        let applied = Vector3::from(command.acceleration_rad_s2);
        let of_follower = black_box(measurement(tick, &follower, &applied, 0b111));
        measuring.time(counts, || ());
        observing.time(counts, || observer.step(&of_leader, &mut estimate));
        controlling.time(counts, || controller.step(&estimate, &of_follower, &mut command));
        leader = body.flow(&leader, &Vector3::zeros(), TICK_S);
        follower = moving.time(counts, || body.flow(&follower, &applied, TICK_S));
    }
    let error = (follower - leader).norm();
    for (name, counted) in [("observer", observing), ("controller", controlling), ("body", moving)] {
        writeln!(Text(board), "{name} {}", counted.mean(&measuring)).ok()?;
    }
    // The loop that was counted is one that works: after 1.1 s the bodies have come nearer.
    writeln!(Text(board), "error_micro_rad_s {}", (error * 1e6) as u32).ok()
}

#[entry]
fn main() -> ! {
    let Some(core) = cortex_m::Peripherals::take() else { halt::halt() };
    let mut board = Board::start(core);
    // SAFETY: this program has the clock for itself from here on.
    let mut core = unsafe { cortex_m::Peripherals::steal() };
    core.SYST.disable_interrupt();
    core.SYST.set_reload(RELOAD);
    core.SYST.clear_current();
    let _ = run(&mut board);
    board.write(b"end\n");
    halt::halt()
}
