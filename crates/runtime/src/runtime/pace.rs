//! Follows the clock of a device that sets the pace: the run's clock is corrected so that the device's frame of tick k
//! arrives at a fixed part of that tick's period.
//!
//! ```text
//! Acquiring --- phase error small, drift known ---> Locked
//!     ^  ^----------- phase error large --------------|
//!     |                                               | no frames
//!     |<-- frames, phase error large -- Holdover <----|
//!     |<-- frames ------------------------ Lost <-- no frames for `holdover_s`
//! ```
//!
//! Holdover and Lost also end in Locked at once if the phase error is still small. Pure but for the correction in shared
//! memory: times are passed in. Must not change a tick's number, nor let time go back.

use super::error::DeviceError;
use crate::bus::domain::Domain;
use crate::clock::{ArrivalEstimator, Correction, Grid, RunClock, STEEPEST};
use crate::config::Settings;
use crate::serial::Cycle;
use crate::shared::SharedWords;
use crate::telemetry::{Latency, PaceReport, Percentiles};
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};

/// Interval of corrections, ns.
const CORRECT_NS: u64 = 50_000_000;
/// Time in which a correction removes the error: while locked, and while acquiring, ns.
const CATCH_UP_NS: f64 = 2e8;
const CATCH_UP_ACQUIRING_NS: f64 = 1e8;
/// The steepest slope while acquiring, ns per ns.
const STEEPEST_ACQUIRING: f64 = 0.01;
/// The phase error up to which the grid is locked, ns and parts of the period; it stays locked up to five times that.
const LOCK_NS: f64 = 20_000.0;
const LOCK_PART: f64 = 0.01;
const UNLOCK: f64 = 5.0;
/// The silence after which the grid runs on by itself, ns and periods.
const SILENT_NS: u64 = 20_000_000;
const SILENT_PERIODS: u64 = 5;
/// Interval of the track's entries, ns, and their largest number.
const TRACK_NS: u64 = 1_000_000_000;
const TRACK_ENTRIES: usize = 3600;

/// The reaction to a device that is silent for longer than the holdover.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnLost {
    /// Sends no commands, so that the device applies its safe command, until the grid is locked again.
    Safe,
    /// Ends the run in order.
    Stop,
}

/// The settings of a device that sets the pace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaceOptions {
    /// The silence after which the device is lost, s.
    pub holdover_s: f64,
    /// The reaction then.
    pub on_lost: OnLost,
}

/// The relation of the grid to the device's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, strum::IntoStaticStr, strum::FromRepr)]
#[strum(serialize_all = "lowercase")]
#[repr(u64)]
pub enum PaceState {
    /// No device sets the pace.
    #[default]
    Free,
    /// The phase error is large, or not yet known.
    Acquiring,
    /// The grid follows the device.
    Locked,
    /// No frames arrive; the grid runs on by the last drift.
    Holdover,
    /// No frames arrive for longer than the holdover.
    Lost,
}

/// The relation of the grid to the device's clock, for viewers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaceStatus {
    /// The state.
    pub state: PaceState,
    /// The phase error of the last window, ns: positive if its least delayed frame was late.
    pub phase_error_ns: i64,
    /// The device's clock against the host's, ppm.
    pub drift_ppm: f64,
    /// The device's slips so far.
    pub slips: u64,
}

/// Words of [`PaceBoard`].
const RUNNING: usize = 0;
const STATE: usize = 1;
const PHASE: usize = 2;
const DRIFT: usize = 3;
const SLIPS: usize = 4;
const WORDS: usize = 5;

/// The clock of a run that a device may set, and its state for viewers, in shared memory. The launcher makes it.
#[derive(Debug)]
pub struct PaceBoard {
    clock: RunClock,
    words: SharedWords,
}

impl PaceBoard {
    /// Opens the board of a run; makes it if it is missing.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(domain: &Domain) -> io::Result<Self> {
        let clock = RunClock::open(&domain.shared(RunClock::PACE))?;
        Self::whole(clock, SharedWords::open(&domain.shared("pace.state"), WORDS)?)
    }

    /// Opens the board of a run if the launcher has made one.
    ///
    /// # Errors
    /// The system's reason, but for a missing board.
    pub fn existing(domain: &Domain) -> io::Result<Option<Self>> {
        let made = domain.shared(RunClock::PACE).exists() && domain.shared("pace.state").exists();
        if made { Self::open(domain).map(Some) } else { Ok(None) }
    }

    fn whole(clock: RunClock, words: SharedWords) -> io::Result<Self> {
        match words.words().len() {
            WORDS => Ok(Self { clock, words }),
            _ => Err(io::Error::other("it is a file of another version")),
        }
    }

    fn word(&self, index: usize) -> &AtomicU64 {
        &self.words.words()[index]
    }

    /// Declares that the epoch is set: from now on the clock is never stepped.
    pub fn run(&self) {
        self.word(RUNNING).store(1, Ordering::Release);
    }

    fn runs(&self) -> bool {
        self.word(RUNNING).load(Ordering::Acquire) == 1
    }

    /// Returns the present status; `None` if no device sets the pace.
    pub fn status(&self) -> Option<PaceStatus> {
        let [state, phase, drift, slips] =
            [STATE, PHASE, DRIFT, SLIPS].map(|index| self.word(index).load(Ordering::Relaxed));
        let state = PaceState::from_repr(state).filter(|state| *state != PaceState::Free)?;
        Some(PaceStatus { state, phase_error_ns: phase as i64, drift_ppm: drift as i64 as f64 / 1e3, slips })
    }
}

/// The frames since the last window's end.
#[derive(Debug, Default, Clone, Copy)]
struct Window {
    number: u64,
    frames: u64,
    /// The least delay of a frame against the grid, ns.
    least_ns: Option<i64>,
}

/// A grid that follows a device.
pub struct Pace {
    board: PaceBoard,
    options: PaceOptions,
    period_ns: u64,
    /// The time from a tick's due time until its frame arrives, ns.
    phase_ns: u64,
    grid: Option<Grid>,
    estimator: ArrivalEstimator,
    state: PaceState,
    /// True from the loss of the device until the grid is locked again.
    withholds: bool,
    window: Window,
    /// The number of the first cycle, and the time at which its frame was due.
    first_cycle: Option<(u32, u64)>,
    first_ns: Option<u64>,
    last_ns: Option<u64>,
    /// The end of the last silence, ns, until the grid is locked again.
    returned_ns: Option<u64>,
    looked_ns: u64,
    next_correction_ns: u64,
    next_track_ns: u64,
    /// The correction at the start, ns.
    start_correction_ns: i64,
    restarts: u64,
    errors: Latency,
    report: PaceReport,
}

impl Pace {
    /// Takes the pace of a run.
    ///
    /// # Errors
    /// [`DeviceError::PaceUnavailable`] and [`DeviceError::PaceTaken`].
    pub fn open(domain: &Domain, scenario: &Settings, options: PaceOptions) -> Result<Self, DeviceError> {
        let unavailable = |reason: String| DeviceError::PaceUnavailable { reason };
        let board = PaceBoard::existing(domain).map_err(|error| unavailable(error.to_string()))?;
        let Some(board) = board else {
            return Err(unavailable("the run is not in real time, or has no driven body that is external".to_owned()));
        };
        if !board.clock.own() {
            return Err(DeviceError::PaceTaken);
        }
        Ok(Self::new(board, scenario.period_ns, scenario.realtime.cutoff, options))
    }

    fn new(board: PaceBoard, period_ns: u64, cutoff: f64, options: PaceOptions) -> Self {
        let lock_ns = Self::lock_ns(period_ns);
        Self {
            board,
            options,
            period_ns,
            // Half the time up to the cutoff: as much for requests that are late as for frames that are.
            phase_ns: (period_ns as f64 * cutoff / 2.0) as u64,
            grid: None,
            estimator: ArrivalEstimator::new(period_ns, UNLOCK * lock_ns),
            state: PaceState::Acquiring,
            withholds: false,
            window: Window::default(),
            first_cycle: None,
            first_ns: None,
            last_ns: None,
            returned_ns: None,
            looked_ns: 0,
            next_correction_ns: 0,
            next_track_ns: 0,
            start_correction_ns: 0,
            restarts: 0,
            errors: Latency::default(),
            report: PaceReport { track: Vec::with_capacity(TRACK_ENTRIES), ..PaceReport::default() },
        }
    }

    fn lock_ns(period_ns: u64) -> f64 {
        LOCK_NS.max(LOCK_PART * period_ns as f64)
    }

    /// Returns the number of received frames.
    pub fn frames(&self) -> u64 {
        self.report.frames
    }

    /// Returns the state.
    pub fn state(&self) -> PaceState {
        self.state
    }

    /// Returns true if the device gets no commands.
    pub fn withholds(&self) -> bool {
        self.withholds
    }

    /// Returns true if the run's epoch was set before this device came.
    pub fn begins_late(&self) -> bool {
        self.board.runs()
    }

    /// Sets the time grid, at which the device's ticks are due from now on.
    pub fn start(&mut self, grid: Grid) {
        self.grid = Some(grid);
    }

    /// Forgets the device's phase: it has started again.
    fn restarted(&mut self) {
        self.estimator.reset();
        self.first_cycle = None;
        self.enter(PaceState::Acquiring);
    }

    /// Takes a frame that arrived at `raw_ns` on this host's monotonic clock.
    #[inline]
    pub fn arrived(&mut self, cycle: Cycle, raw_ns: u64) {
        let run_ns = self.board.clock.get().apply(raw_ns);
        let due_ns = match (cycle, self.grid) {
            (Cycle::Tick(tick), Some(grid)) => grid.due_ns(tick) + self.phase_ns,
            // The launcher places tick 0 at a multiple of the period.
            (Cycle::Idle(number), grid) if grid.is_none() || self.first_cycle.is_some() => {
                self.idle_due_ns(number, run_ns)
            }
            _ => return,
        };
        self.first_ns.get_or_insert(raw_ns);
        if let PaceState::Holdover | PaceState::Lost = self.state {
            self.returned_ns.get_or_insert(raw_ns);
        }
        self.last_ns = self.last_ns.max(Some(raw_ns));
        self.report.frames += 1;
        let number = raw_ns / self.estimator.window_ns();
        if number != self.window.number {
            self.end_window(raw_ns);
            self.window.number = number;
        }
        let late_ns = run_ns.wrapping_sub(due_ns) as i64;
        self.window.frames += 1;
        self.window.least_ns = Some(self.window.least_ns.map_or(late_ns, |least_ns| least_ns.min(late_ns)));
        self.estimator.take(due_ns, raw_ns);
    }

    /// Returns the time at which the frame of a cycle before tick 0 is due. That of the first frame is the next possible one.
    fn idle_due_ns(&mut self, number: u32, run_ns: u64) -> u64 {
        let period_ns = self.period_ns;
        let next_ns = run_ns.saturating_sub(self.phase_ns).next_multiple_of(period_ns) + self.phase_ns;
        let (first, first_ns) = *self.first_cycle.get_or_insert((number, next_ns));
        first_ns.wrapping_add_signed(i64::from(number.wrapping_sub(first) as i32).wrapping_mul(period_ns as i64))
    }

    fn end_window(&mut self, raw_ns: u64) {
        let Window { frames, least_ns: Some(least_ns), .. } = std::mem::take(&mut self.window) else { return };
        let error_ns = least_ns.unsigned_abs();
        // Of few frames, as at the edge of a cut, even the least delay is that of the way.
        let tells = frames >= self.estimator.window_ns() / self.period_ns / 2;
        let locks = (error_ns as f64) <= Self::lock_ns(self.period_ns) && self.estimator.knows_drift();
        let unlocks = tells && error_ns as f64 > UNLOCK * Self::lock_ns(self.period_ns);
        if tells {
            self.board.word(PHASE).store(least_ns as u64, Ordering::Relaxed);
            if self.grid.is_some() && self.report.locked_after_s.is_some() {
                self.errors.record(0, error_ns);
            }
        }
        match self.state {
            PaceState::Locked if !unlocks => {}
            PaceState::Holdover | PaceState::Lost if !locks && !unlocks => {}
            _ if locks => {
                let seconds = |from_ns: u64| raw_ns.saturating_sub(from_ns) as f64 / 1e9;
                if let Some(returned_ns) = self.returned_ns.take() {
                    let longest_s = self.report.relocked_after_s_max.unwrap_or(0.0);
                    self.report.relocked_after_s_max = Some(longest_s.max(seconds(returned_ns)));
                }
                if self.report.locked_after_s.is_none() {
                    self.report.locked_after_s = self.first_ns.map(seconds);
                }
                self.withholds = false;
                self.enter(PaceState::Locked);
            }
            _ => self.enter(PaceState::Acquiring),
        }
    }

    fn enter(&mut self, state: PaceState) {
        self.state = state;
        self.board.word(STATE).store(state as u64, Ordering::Relaxed);
    }

    /// Corrects the clock if that is due, and looks for silence if all received frames have been taken (`drained`).
    /// `slips` and `restarts` are the device's so far.
    ///
    /// # Errors
    /// [`DeviceError::PaceLost`] if the device is lost and the run shall end.
    #[inline]
    pub fn look(&mut self, raw_ns: u64, drained: bool, slips: u64, restarts: u64) -> Result<(), DeviceError> {
        if std::mem::replace(&mut self.restarts, restarts) < restarts {
            self.restarted();
        }
        if drained {
            self.look_for_silence(raw_ns)?;
        }
        if raw_ns >= self.next_correction_ns {
            self.next_correction_ns = raw_ns + CORRECT_NS;
            self.board.word(SLIPS).store(slips, Ordering::Relaxed);
            self.correct(raw_ns);
        }
        Ok(())
    }

    fn look_for_silence(&mut self, raw_ns: u64) -> Result<(), DeviceError> {
        let silent_ns = self.last_ns.map_or(0, |last_ns| raw_ns.saturating_sub(last_ns));
        let limit_ns = SILENT_NS.max(SILENT_PERIODS.saturating_mul(self.period_ns));
        let since_ns = raw_ns.saturating_sub(std::mem::replace(&mut self.looked_ns, raw_ns)).min(limit_ns);
        if self.grid.is_none() || silent_ns <= limit_ns {
            return Ok(());
        }
        self.returned_ns = None;
        match self.state {
            PaceState::Holdover if silent_ns as f64 / 1e9 > self.options.holdover_s => {
                self.report.lost += 1;
                self.withholds = true;
                self.enter(PaceState::Lost);
                if self.options.on_lost == OnLost::Stop {
                    return Err(DeviceError::PaceLost { silent_s: silent_ns as f64 / 1e9 });
                }
            }
            PaceState::Locked | PaceState::Acquiring => {
                self.report.holdovers += 1;
                self.report.holdover_s += silent_ns as f64 / 1e9;
                self.enter(PaceState::Holdover);
            }
            _ => self.report.holdover_s += since_ns as f64 / 1e9,
        }
        Ok(())
    }

    fn correct(&mut self, raw_ns: u64) {
        let Some(estimate) = self.estimator.at(raw_ns) else { return };
        let is_ns = self.board.clock.get().at(raw_ns);
        let error_ns = estimate.offset_ns - is_ns as f64;
        if self.grid.is_none() && !self.board.runs() && error_ns > 0.0 {
            // Before the first tick time may jump, forwards only.
            self.board.clock.set(Correction::new(raw_ns, estimate.offset_ns as i64, estimate.drift));
            return;
        }
        let (steepest, catch_up_ns) = match self.state {
            PaceState::Acquiring => (STEEPEST_ACQUIRING, CATCH_UP_ACQUIRING_NS),
            _ => (STEEPEST, CATCH_UP_NS),
        };
        let slope = (estimate.drift + error_ns / catch_up_ns).clamp(-steepest, steepest);
        self.board.clock.set(Correction::within(raw_ns, is_ns, slope, steepest));
        self.board.word(DRIFT).store((estimate.drift * 1e9) as i64 as u64, Ordering::Relaxed);
        if self.grid.is_none() {
            self.start_correction_ns = is_ns;
            return;
        }
        self.report.drift_ppm = estimate.drift * 1e6;
        self.report.corrections += 1;
        self.report.largest_correction_us = self.report.largest_correction_us.max(error_ns.abs() / 1e3);
        self.report.steepest_ppm = self.report.steepest_ppm.max(slope.abs() * 1e6);
        if raw_ns >= self.next_track_ns && self.report.track.len() < TRACK_ENTRIES {
            self.next_track_ns = raw_ns + TRACK_NS;
            let since_s = self.first_ns.map_or(0.0, |first_ns| raw_ns.saturating_sub(first_ns) as f64 / 1e9);
            let phase_ns = self.board.word(PHASE).load(Ordering::Relaxed) as i64;
            self.report.track.push([since_s, (is_ns - self.start_correction_ns) as f64 / 1e3, phase_ns as f64 / 1e3]);
        }
    }

    /// Returns the report of the run so far, with the device's slips.
    pub fn report(&self, slips: u64) -> PaceReport {
        let errors = (!self.errors.is_empty()).then(|| self.errors.percentiles());
        let figure = |figure: fn(&Percentiles) -> f64| errors.as_ref().map(figure);
        let state: &str = self.state.into();
        PaceReport {
            state: state.to_owned(),
            slips,
            phase_error_p50_us: figure(|errors| errors.p50_us),
            phase_error_p99_us: figure(|errors| errors.p99_us),
            phase_error_max_us: figure(|errors| errors.max_us),
            ..self.report.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ops::Range;

    const PERIOD_NS: u64 = 2_000_000;
    const STEP_NS: u64 = 100_000;
    const SECOND_NS: u64 = 1_000_000_000;
    const EPOCH_NS: u64 = 50_000 * PERIOD_NS;

    /// A device whose timer is off, on a line with one-sided jitter that is cut at times.
    struct World {
        ppm: f64,
        jitter_ns: f64,
        cuts: Vec<Range<u64>>,
        random: u64,
        _directory: tempfile::TempDir,
        pace: Pace,
        /// The local time of the device's next cycle, and that cycle's tick; ticks begin at the first one of the run.
        next_ns: f64,
        tick: Option<u64>,
        cycle: u32,
        /// Frames on their way.
        flying: Vec<(u64, Cycle)>,
        now_ns: u64,
        last_run_ns: u64,
    }

    impl World {
        fn new(ppm: f64, cuts: &[Range<u64>], on_lost: OnLost) -> Self {
            let directory = tempfile::tempdir().unwrap();
            let path = |name: &str| directory.path().join(name);
            let clock = RunClock::open(&path("clock")).unwrap();
            let board = PaceBoard::whole(clock, SharedWords::open(&path("words"), WORDS).unwrap()).unwrap();
            let pace = Pace::new(board, PERIOD_NS, 0.75, PaceOptions { holdover_s: 5.0, on_lost });
            let now_ns = 90 * SECOND_NS;
            Self {
                ppm,
                jitter_ns: 300e3,
                cuts: cuts.to_vec(),
                random: 7,
                _directory: directory,
                pace,
                next_ns: now_ns as f64 + 777_777.0,
                tick: None,
                cycle: 0,
                flying: Vec::new(),
                now_ns,
                last_run_ns: 0,
            }
        }

        fn run_ns(&self) -> u64 {
            self.pace.board.clock.get().apply(self.now_ns)
        }

        /// Lets a tenth of a millisecond pass.
        fn step(&mut self) -> Result<(), DeviceError> {
            self.now_ns += STEP_NS;
            let run_ns = self.run_ns();
            assert!(run_ns > self.last_run_ns, "time goes back");
            self.last_run_ns = run_ns;
            while self.next_ns <= self.now_ns as f64 {
                // The generator of Knuth's MMIX.
                self.random =
                    self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let uniform = (self.random >> 11) as f64 / (1_u64 << 53) as f64;
                let arrival_ns = (self.next_ns + uniform * self.jitter_ns) as u64;
                // The first request came with the grid's first tick.
                if self.pace.grid.is_some() && self.tick.is_none() && run_ns >= EPOCH_NS {
                    self.tick = Some(0);
                }
                let cycle = self.tick.map_or(Cycle::Idle(self.cycle), Cycle::Tick);
                self.cycle += 1;
                self.tick = self.tick.map(|tick| tick + 1);
                self.next_ns += PERIOD_NS as f64 / (1.0 + self.ppm * 1e-6);
                if !self.cuts.iter().any(|cut| cut.contains(&self.since_epoch_ns())) {
                    self.flying.push((arrival_ns, cycle));
                }
            }
            let (now_ns, pace) = (self.now_ns, &mut self.pace);
            self.flying.retain(|(at_ns, cycle)| {
                let flies = *at_ns > now_ns;
                if !flies {
                    pace.arrived(*cycle, *at_ns);
                }
                flies
            });
            self.pace.look(now_ns, true, 0, 0)
        }

        fn since_epoch_ns(&self) -> u64 {
            self.run_ns().saturating_sub(EPOCH_NS)
        }

        /// Follows the device before the epoch, then through this time. Returns the largest true phase error, ns, in each second.
        fn follow(&mut self, seconds: u64) -> Result<Vec<f64>, DeviceError> {
            while self.run_ns() < EPOCH_NS - 20_000_000 {
                self.step()?;
            }
            assert_eq!(self.pace.state(), PaceState::Locked);
            self.pace.board.run();
            self.pace.start(Grid { epoch_ns: EPOCH_NS, period_ns: PERIOD_NS });
            let mut worst = vec![0.0_f64; seconds as usize + 1];
            while self.since_epoch_ns() < seconds * SECOND_NS {
                self.step()?;
                let second = (self.since_epoch_ns() / SECOND_NS) as usize;
                if let Some(tick) = self.tick {
                    // Of the next cycle, had it the fastest way.
                    let cycle_ns = self.pace.board.clock.get().apply(self.next_ns as u64) as f64;
                    let due_ns = (EPOCH_NS + tick * PERIOD_NS + self.pace.phase_ns) as f64;
                    worst[second] = worst[second].max((cycle_ns - due_ns).abs());
                }
            }
            Ok(worst)
        }
    }

    #[test]
    fn the_grid_follows_a_device_whose_timer_is_off() {
        for ppm in [100.0, -100.0, 0.0] {
            let mut world = World::new(ppm, &[], OnLost::Safe);
            let worst = world.follow(20).unwrap();
            println!("{ppm} ppm: {worst:.0?} ns");
            assert!(worst.iter().all(|error_ns| *error_ns < 20e3), "{ppm}: {worst:?}");
            let report = world.pace.report(0);
            assert!((report.drift_ppm - ppm).abs() < 2.0 && report.phase_error_p99_us < Some(20.0), "{report:?}");
            assert!(
                report.state == "locked" && report.locked_after_s < Some(2.0) && report.holdovers == 0,
                "{report:?}"
            );
            assert!(report.steepest_ppm <= STEEPEST * 1e6 && report.track.len() >= 19, "{report:?}");
        }
    }

    #[test]
    fn after_a_cut_the_grid_is_locked_again_within_a_second() {
        // Shortly after the edges of windows, in which a few frames arrive then.
        let cuts = [5 * SECOND_NS + 6_000_000..6 * SECOND_NS, 12 * SECOND_NS + 4_000_000..22 * SECOND_NS];
        for ppm in [100.0, -100.0, 0.0] {
            let mut world = World::new(ppm, &cuts, OnLost::Safe);
            let worst = world.follow(30).unwrap();
            println!("{ppm} ppm: {worst:.0?} ns");
            assert!(worst.iter().all(|error_ns| *error_ns < 60e3), "{ppm}: {worst:?}");
            let report = world.pace.report(0);
            assert!((report.holdovers, report.lost, &*report.state) == (2, 1, "locked"), "{report:?}");
            assert!(report.phase_error_max_us < Some(60.0), "{report:?}");
            assert!(report.relocked_after_s_max < Some(1.0) && !world.pace.withholds(), "{report:?}");
            assert!((report.holdover_s - 11.0).abs() < 0.2, "{report:?}");
        }
    }

    #[test]
    fn a_lost_device_ends_the_run_if_that_is_the_policy() {
        let cut = 3 * SECOND_NS..60 * SECOND_NS;
        let mut world = World::new(50.0, std::slice::from_ref(&cut), OnLost::Stop);
        let lost = world.follow(20);
        assert!(matches!(lost, Err(DeviceError::PaceLost { silent_s }) if (5.0..5.1).contains(&silent_s)), "{lost:?}");
        assert!(world.pace.withholds() && world.pace.state() == PaceState::Lost);
    }

    /// A device that was switched off and on again while the ticks run.
    #[test]
    fn another_phase_is_reached_by_slewing() {
        let mut world = World::new(20.0, &[], OnLost::Safe);
        world.follow(4).unwrap();
        world.pace.restarted();
        world.next_ns += 900_000.0;
        let tick_of_ns = |world: &World| world.pace.board.clock.get().apply(world.next_ns as u64) - EPOCH_NS;
        world.tick = Some(tick_of_ns(&world).div_ceil(PERIOD_NS));
        let end_ns = world.now_ns + 5 * SECOND_NS;
        while world.now_ns < end_ns {
            world.step().unwrap();
        }
        let report = world.pace.report(0);
        assert!(report.state == "locked" && report.steepest_ppm <= STEEPEST_ACQUIRING * 1e6 + 1.0, "{report:?}");
    }
}
