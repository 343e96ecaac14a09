//! The launcher's view of the recorder of a run: started beside the roles, or by the user while they run.
//!
//! In lockstep no role runs ahead of it, or of the scorer, by more than the window. Must not let a dead or silent recorder delay
//! the run.

use super::companion::Companion;
use super::error::LaunchError;
use super::janitor::Janitor;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal};
use crate::clock::monotonic_ns;
use crate::hosts::NetworkStatistics;
use crate::record::{JOINING, RECORDER, RecordingReport};
use crate::runtime::topic;
use crate::sample::{Health, RoleState};
use crate::scenario::Scenario;
use crate::seat::report_path;
use crate::telemetry::RoleReport;
use std::path::Path;
use std::process::Command;

/// Longest time that one check adds to its silence, ns: a paused launcher must not blame the recorder.
const LOOK_MAX_NS: u64 = 100_000_000;

/// A run's recorder, if it has one.
pub(super) struct RecorderWatch {
    pub companion: Companion,
    /// The name of the file, if the run started the recorder.
    file: Option<String>,
    health: <IoxBus as Bus>::Reader<Health>,
    last: Health,
    /// The credit while it joins.
    joined_at: Option<u64>,
    silent_ns: u64,
    looked_ns: u64,
    limit_ns: u64,
    problem: Option<String>,
}

impl RecorderWatch {
    /// Starts a recorder to `file`; without a file, expects one that the user may start.
    pub fn start(file: Option<&Path>, scenario: &Scenario, domain: &Domain, bus: &IoxBus) -> Result<Self, LaunchError> {
        let arguments = file.map(|file| {
            move |command: &mut Command| {
                command.arg("record").arg("--domain").arg(domain.root()).arg("--out").arg(file);
            }
        });
        Ok(Self {
            health: bus.reader(&topic(scenario, RECORDER, Signal::Health), Reader::Role)?,
            companion: Companion::start(RECORDER, arguments)?,
            file: file.map(|file| file.file_name().unwrap_or_default().to_string_lossy().into_owned()),
            last: Health::default(),
            joined_at: None,
            silent_ns: 0,
            looked_ns: monotonic_ns(),
            limit_ns: (scenario.supervision.heartbeat_timeout_s * 1e9) as u64,
            problem: None,
        })
    }

    /// Reads the recorder's status.
    pub fn listen(&mut self) -> Result<(), BusError> {
        let now_ns = monotonic_ns();
        self.silent_ns += now_ns.saturating_sub(self.looked_ns).min(LOOK_MAX_NS);
        self.looked_ns = now_ns;
        while self.health.advance()? {
            if let Some(health) = self.health.current() {
                (self.last, self.silent_ns) = (*health, 0);
            }
        }
        Ok(())
    }

    /// Returns true once it has reached a state before the ticks, or its failure.
    pub fn has_reached(&mut self, state: RoleState) -> Result<bool, LaunchError> {
        let (name, Some(process)) = self.companion.process() else { return Ok(true) };
        process.require_alive(name)?;
        Ok(self.state() >= state)
    }

    /// Returns the last tick that every required reader has received; without the recorder it is `scored`, and the last credit was
    /// `given`. A recorder that joined late receives nothing while the writers wait, so there is credit for one more tick.
    pub fn credit(&mut self, scored: u64, given: u64) -> Result<u64, BusError> {
        self.listen()?;
        if !self.active() {
            self.joined_at = None;
            return Ok(scored);
        }
        Ok(scored.min(match self.last.stamp.tick {
            JOINING => *self.joined_at.get_or_insert(given + 1),
            tick => tick,
        }))
    }

    /// Checks if it has failed: then the run goes on without it.
    pub fn supervise(&mut self, janitor: &mut Janitor) {
        if self.problem.is_some() || self.state() == RoleState::Done {
            return;
        }
        let silent = self.active() && self.silent_ns > self.limit_ns;
        self.problem = self.companion.loss(silent, janitor);
    }

    /// Returns true while it writes: our process has not ended, or a recorder of the user has not reported its end.
    pub fn lingers(&mut self) -> bool {
        // If the link has failed, only its last status is lost.
        let _ = self.listen();
        self.companion.lingers() || self.file.is_none() && self.active()
    }

    /// Returns the contents of the file, beside the roles' final counters. A recorder that still runs is ended.
    pub fn finish(
        mut self,
        domain: &Domain,
        roles: &[RoleReport],
        hosts: Option<&NetworkStatistics>,
    ) -> Option<RecordingReport> {
        let file = self.file.take()?;
        let late = self.companion.lingers();
        drop(self.companion);
        let left = std::fs::read(report_path(domain.root(), RECORDER)).ok();
        let report = left.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        let mut report: RecordingReport = report.unwrap_or_else(|| {
            let how = if late { "it had not completed its file in time and was killed" } else { "it left no report" };
            let problem = self.problem.unwrap_or_else(|| how.to_owned());
            let code = Some("recorder-lost".to_owned());
            let (messages, bytes, signals) = (0, 0, Vec::new());
            RecordingReport {
                file,
                complete: false,
                whole: true,
                problem: Some(problem),
                code,
                messages,
                bytes,
                signals,
            }
        });
        report.reconcile(roles, &|service| hosts.map_or(0, |hosts| hosts.lost(service)));
        Some(report)
    }

    /// Returns true if a recorder takes samples or is about to: from its first status on.
    fn active(&self) -> bool {
        let records = (RoleState::Ready..RoleState::Done).contains(&self.state());
        records && self.problem.is_none() && self.health.has_writer()
    }

    fn state(&self) -> RoleState {
        RoleState::from_number(self.last.state)
    }
}
