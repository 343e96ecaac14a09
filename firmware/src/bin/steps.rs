//! Counts the instructions of a step on a machine where one instruction takes one nanosecond (`-icount shift=0`), and
//! the stack used by the flight computer.
//!
//! Prints one figure per line to the UART. The loop is that of `config/rigid-pair.toml`, with simulated bodies.

#![no_std]
#![no_main]

use core::fmt::{self, Write};
use core::hint::black_box;
use corotate::model::RigidBody;
use corotate::role::{Controller, Observer};
use corotate::sample::{Message as _, RateCommand, RateEstimate, RateMeasurement};
use corotate::serial::{Device, Hello, MAX_FRAME, MAX_PAYLOAD, Message, Samples, Tick, encode, write};
use corotate_firmware::board::Board;
use corotate_firmware::{flight, halt, pair};
use cortex_m::peripheral::SYST;
use cortex_m_rt::entry;
use nalgebra::Vector3;

/// The period h, s, the number of ticks, and the number of initial ticks that are not measured.
const TICK_S: f64 = 0.001;
const TICKS: u64 = 1100;
const FIRST: u64 = 100;
/// The number of instructions per count of the clock: at 25 MHz and one instruction per nanosecond.
const PER_COUNT: u32 = 40;
/// The initial value of the clock, which counts down without an interrupt; no step takes that long.
const RELOAD: u32 = 0x00ff_ffff;

struct Text<'a>(&'a mut Board);

impl Write for Text<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.write(text.as_bytes());
        Ok(())
    }
}

/// The instructions of all measured steps, in counts of the clock.
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

    /// Returns the instructions per step, less those of the measurement itself.
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

const MEASUREMENT: usize = 64;
/// The marked bytes of the stack, more than the device uses.
const MARKED: usize = 64 << 10;
const MARK: u32 = 0x5ac3_3ca5;
/// The bytes below the caller's frame that are not marked.
const MARGIN: usize = 256;

/// Marks the stack below the caller's frame and returns its lowest marked address.
#[inline(never)]
fn mark() -> usize {
    let here = cortex_m::register::msp::read() as usize - MARGIN;
    for address in (here - MARKED..here).step_by(4) {
        // SAFETY: memory below the stack pointer is unused, and no interrupt occurs.
        unsafe { (address as *mut u32).write_volatile(MARK) };
    }
    here
}

/// Returns the number of bytes used below `top` since the stack was marked from `here` on.
fn used(top: usize, here: usize) -> usize {
    let mut address = here - MARKED;
    // SAFETY: memory of the stack, only read.
    while address < here && unsafe { (address as *const u32).read_volatile() } == MARK {
        address += 4;
    }
    top - address
}

fn frame<'a>(message: Message<'_>, room: &'a mut [u8; MAX_FRAME]) -> Option<&'a [u8]> {
    let mut payload = [0; MAX_PAYLOAD];
    let payload = write(0, message, &mut payload).ok()?;
    encode(payload, room).ok()
}

/// Measures the flight computer behind its line, from the first byte of a request to the last of the answer.
#[inline(never)]
fn exchange() -> Option<u32> {
    let mut device = Device::new(flight::NAME, flight::make_role);
    let (mut room, mut counted, mut measuring) = ([0; MAX_FRAME], Counted::default(), Counted::default());
    let hello = Hello {
        run: 1,
        realtime: false,
        period_ns: 1_000_000,
        last_tick: TICKS,
        timeout_ticks: 20,
        manual_rearm: false,
        role: "observer controller",
        reads: "corotate/rigid-body/measurement/v1#bcfd8b41 corotate/rigid-body/measurement/v1#bcfd8b41",
        writes: "corotate/rigid-body/estimate/v2#d53fab65 corotate/rigid-body/command/v2#ff8ce508",
    };
    device.receive(frame(Message::Hello(hello), &mut room)?, 0, |_| {});
    let mut answered = 0;
    for tick in 0..TICKS {
        let phase = tick as f64 * TICK_S;
        let rate = Vector3::new(0.6 + 0.1 * phase, -0.4 + 0.2 * phase, 0.0);
        let mut bytes = [0; 2 * MEASUREMENT];
        bytes[..MEASUREMENT].copy_from_slice(measurement(tick, &rate, &Vector3::zeros(), 0b011).content());
        bytes[MEASUREMENT..].copy_from_slice(measurement(tick, &rate, &Vector3::zeros(), 0b111).content());
        let asked = frame(Message::Tick(Tick { tick, inputs: Samples { present: 0b11, bytes: &bytes } }), &mut room)?;
        measuring.time(tick >= FIRST, || ());
        counted.time(tick >= FIRST, || device.receive(asked, 0, |_| answered += 1));
    }
    (answered == TICKS).then(|| counted.mean(&measuring))
}

fn run(board: &mut Board) -> Option<()> {
    let body = RigidBody::new(&pair::inertia()?);
    let (mut leader, mut follower) = (Vector3::from(pair::LEADER_RATE_RAD_S), Vector3::from(pair::FOLLOWER_RATE_RAD_S));
    let mut observer = Observer::new(pair::observer()?, TICK_S);
    let mut controller = Controller::new(pair::law(TICK_S)?, TICK_S);
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
        controlling.time(counts, || controller.step(&estimate, None, &of_follower, &mut command));
        leader = body.flow(&leader, &Vector3::zeros(), TICK_S);
        follower = moving.time(counts, || body.flow(&follower, &applied, TICK_S));
    }
    let error = (follower - leader).norm();
    for (name, counted) in [("observer", observing), ("controller", controlling), ("body", moving)] {
        writeln!(Text(board), "{name} {}", counted.mean(&measuring)).ok()?;
    }
    // The measured loop must work: after 1.1 s the error has decreased.
    writeln!(Text(board), "error_micro_rad_s {}", (error * 1e6) as u32).ok()
}

#[entry]
fn main() -> ! {
    let Some(core) = cortex_m::Peripherals::take() else { halt::halt() };
    let mut board = Board::start(core);
    // SAFETY: only this code uses the clock from here on.
    let mut core = unsafe { cortex_m::Peripherals::steal() };
    core.SYST.disable_interrupt();
    core.SYST.set_reload(RELOAD);
    core.SYST.clear_current();
    let top = cortex_m::register::msp::read() as usize;
    let here = mark();
    let exchanged = exchange();
    let stack = used(top, here);
    if let Some(exchanged) = exchanged {
        let _ = writeln!(Text(&mut board), "exchange {exchanged}\nstack {stack}");
        let _ = run(&mut board);
    }
    board.write(b"end\n");
    halt::halt()
}
