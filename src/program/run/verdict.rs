//! The verdict of a finished run.

use super::super::color::Color;
use super::super::output::{Exit, Failure, fail, remark};
use crate::launch::{Action, Summary, exact, tick_words};

const PASS: (&str, Color) = ("PASS", Color::Green);
const FAIL: (&str, Color) = ("FAIL", Color::Red);
const NOT_JUDGED: (&str, Color) = ("NOT JUDGED", Color::Yellow);

/// The verdict of a finished run: exit code and last line.
pub(super) struct Verdict {
    pub exit: Exit,
    pub word: (&'static str, Color),
    pub reason: String,
}

impl Verdict {
    fn with(exit: Exit, word: (&'static str, Color), reason: impl Into<String>) -> Self {
        Self { exit, word, reason: reason.into() }
    }

    /// Judges a run and prints its problems to stderr. The reason always counts missed, starved and safe ticks.
    pub fn new(summary: &Summary) -> Self {
        let verdict = Self::without_ticks(summary);
        let ticks = tick_words(&summary.books);
        let reason = if ticks.is_empty() { verdict.reason } else { format!("{}; {ticks}", verdict.reason) };
        Self { reason, ..verdict }
    }

    fn without_ticks(summary: &Summary) -> Self {
        if !summary.books.balanced {
            let exit = fail(
                Exit::Failure,
                Failure::new("unbalanced", "the counters do not balance: samples or ticks are unaccounted for"),
            );
            return Self::with(exit, FAIL, "the counters do not balance");
        }
        if let Some(stopped) = summary.incidents.iter().find(|incident| incident.action == Action::Stopped) {
            // A run in one thread has not printed it yet.
            if stopped.panic.is_some() && summary.clock == "in-process" {
                remark(stopped);
            }
            let why = stopped.panic.as_ref().map_or(String::new(), |panic| format!(": {panic}"));
            return Self::with(Exit::ProcessLost, FAIL, format!("the role {} was lost{why}", stopped.role));
        }
        if let Some(problem) = summary.recording.as_ref().and_then(|recording| recording.problem.as_ref()) {
            let exit = fail(
                Exit::Failure,
                Failure::new("incomplete-recording", format!("the recording is incomplete: {problem}")),
            );
            return Self::with(exit, FAIL, "the recording is incomplete");
        }
        let broken: Vec<_> = summary.criteria.iter().filter(|criterion| criterion.holds == Some(false)).collect();
        for criterion in &broken {
            let value = criterion.value.map_or("not measured".to_owned(), exact);
            let role = criterion.role.as_ref().map_or(String::new(), |role| format!("{role}: "));
            let text = format!("accept.{}: {role}{value}, limit {}", criterion.name, exact(criterion.limit));
            remark(&Failure::new("not-met", text));
        }
        let ended = (summary.signal != 0).then(|| format!("stopped by signal {}", summary.signal));
        ended.iter().for_each(|ended| remark(&Failure::new("interrupted", ended)));
        let signal = (summary.signal != 0).then_some(Exit::Signal(summary.signal));
        match summary.accepted {
            Some(true) => {
                let held = summary.criteria.iter().filter(|criterion| criterion.holds == Some(true)).count();
                let left = match summary.criteria.len() - held {
                    0 => String::new(),
                    left => format!(", {left} not judged"),
                };
                Self::with(signal.unwrap_or(Exit::Ok), PASS, format!("{}{left}", counted(held, "holds", "hold")))
            }
            Some(false) => {
                let reason = format!("{} of {} not met", broken.len(), counted(summary.criteria.len(), "", ""));
                Self::with(signal.unwrap_or(Exit::NotAccepted), FAIL, reason)
            }
            None => {
                let reason = summary.verdict.strip_prefix("not judged: ").unwrap_or(&summary.verdict);
                Self::with(signal.unwrap_or(Exit::Ok), NOT_JUDGED, ended.as_deref().unwrap_or(reason))
            }
        }
    }
}

/// Returns the number of criteria with a verb in singular or plural.
fn counted(count: usize, singular: &str, plural: &str) -> String {
    let text = if count == 1 { format!("1 criterion {singular}") } else { format!("{count} criteria {plural}") };
    text.trim_end().to_owned()
}
