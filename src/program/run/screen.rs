//! Output during a run.

use super::super::output::{event, remark};
use super::super::shipped::name;
use crate::config::BodyInfo;
use crate::launch::Progress;
use crate::seat::seat_path;
use crate::system::tell;
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The amount of output during a run.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Verbosity {
    /// Nothing.
    Quiet,
    /// A progress bar on a terminal, and instructions for the user.
    Usual,
    /// Also the directory and the phases.
    Verbose,
}

/// Output during a run: a progress bar on a terminal, instructions, phases and events.
pub(super) struct Screen {
    bar: Option<ProgressBar>,
    /// True once the user has instructions for missing roles or hosts.
    instructed: bool,
    /// The bodies of the scenario; a device cannot replace a fleet.
    bodies: Vec<BodyInfo>,
    pub level: Verbosity,
    /// The last printed phase.
    last_phase: String,
    /// True if events are printed.
    events: bool,
    /// The command by which other hosts join, without the host's name.
    join_command: Option<String>,
}

impl Screen {
    pub fn new(bodies: Vec<BodyInfo>, level: Verbosity, events: bool, join_command: Option<String>) -> Self {
        Self { bar: None, instructed: false, bodies, level, last_phase: String::new(), events, join_command }
    }

    pub fn show(&mut self, progress: &Progress<'_>) {
        self.print_phase(progress);
        match progress {
            _ if self.level == Verbosity::Quiet => {}
            Progress::Waiting { hosts, .. } if !hosts.is_empty() && !self.instructed => {
                self.instructed = true;
                let join_command = self.join_command.as_deref().unwrap_or_default();
                for host in hosts {
                    tell(format_args!("waiting for host {host}: run there\n  {} {join_command} --host {host}", name()));
                }
            }
            Progress::Waiting { external, domain, .. } if !external.is_empty() && !self.instructed => {
                self.instructed = true;
                for role in external {
                    tell(format_args!("waiting for {role}: start it with\n  {}", self.by_hand(role, domain)));
                    let seat = seat_path(domain, role);
                    tell(format_args!("or pass this seat to your own program\n  {}", seat.display()));
                }
            }
            Progress::Waiting { .. } => {}
            Progress::External(words) => match &self.bar {
                Some(bar) => bar.suspend(|| tell(words)),
                None => tell(words),
            },
            Progress::Running { tick, last_tick, metric } => {
                let bar = self.bar.get_or_insert_with(|| bar(*last_tick));
                bar.set_position(*tick);
                bar.set_message(if metric.is_nan() { "-".to_owned() } else { format!("{metric:.2e}") });
            }
        }
    }

    /// Prints each phase of a run once, as text with `--verbose` and as events.
    fn print_phase(&mut self, progress: &Progress<'_>) {
        let phase = match progress {
            Progress::Waiting { domain, hosts, .. } if !hosts.is_empty() => {
                format!("the run's domain is {}; waiting for {}", domain.display(), hosts.join(", "))
            }
            Progress::Waiting { domain, .. } => format!("the run's domain is {}", domain.display()),
            Progress::Running { last_tick, .. } => format!("running ticks 0 to {last_tick}"),
            Progress::External(words) if self.events => {
                // As below.
                let _ = event("notice", serde_json::json!({ "text": words }));
                return;
            }
            Progress::External(_) => return,
        };
        if phase != self.last_phase {
            self.print_verbose(format_args!("{phase}"));
            self.last_phase = phase;
            if self.events {
                // A failure to print is reported at the end of the run.
                let _ = match progress {
                    Progress::Waiting { external, domain, hosts, .. } => {
                        let seat = |role: &&str| (role.to_string(), seat_path(domain, role));
                        let seats: BTreeMap<String, PathBuf> = external.iter().map(seat).collect();
                        event("waiting", serde_json::json!({ "domain": domain, "seats": seats, "hosts": hosts }))
                    }
                    Progress::Running { last_tick, .. } => {
                        event("running", serde_json::json!({ "last_tick": last_tick }))
                    }
                    Progress::External(_) => Ok(()),
                };
            }
        }
    }

    pub fn print_verbose(&self, words: std::fmt::Arguments<'_>) {
        if self.level == Verbosity::Verbose {
            remark(&words);
        }
    }

    fn by_hand(&self, role: &str, domain: &Path) -> String {
        let (name, domain) = (name(), domain.display());
        let fleets = self.bodies.iter().any(|body| body.fleet.is_some());
        let further = || self.bodies.iter().skip(1).filter(|body| body.observer.is_some());
        let observed = further().find(|body| body.observer.as_deref() == Some(role));
        let (command, device) = match (role, observed) {
            ("observer", _) => (role.to_owned(), !fleets),
            ("controller", _) => (role.to_owned(), !fleets && !further().any(|body| body.driven)),
            (_, Some(body)) => (format!("observer --body {}", body.name), true),
            (body, None) => {
                let fleet = self.bodies.iter().any(|info| info.name == body && info.fleet.is_some());
                (format!("plant --body {body}"), body != "leader" && !fleet)
            }
        };
        let by_hand = format!("{name} {command} --domain {domain}");
        let bridge =
            || format!("\nor connect a device with\n  {name} bridge --serial PATH --role {role} --domain {domain}");
        if device { by_hand + &bridge() } else { by_hand }
    }

    pub fn clear(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

fn bar(last_tick: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} tick {pos}/{len} {eta} left, error {msg}");
    // Drawn on stderr, and only if that is a terminal.
    ProgressBar::new(last_tick).with_style(style.expect("the template is a constant that parses"))
}
