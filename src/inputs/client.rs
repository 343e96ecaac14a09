//! The other end: asks the launcher of a run, after the wanted values have been checked.

use super::protocol::{Answer, LINE_MAX, Request, WantedChange};
use super::server::socket_path;
use crate::config::{ConfigError, Document};
use crate::scenario::{Scenario, claims};
use crate::seat::scenario_of;
use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;
use toml::Value;

/// The time that a launcher has to answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// The codes of refusals.
const CODES: [&str; 10] = [
    "not-tunable",
    "wrong-type",
    "wrong-shape",
    "out-of-range",
    "external-role",
    "too-early",
    "after-end",
    "too-many",
    "no-change",
    "busy",
];

/// A change was not made.
#[derive(Debug, thiserror::Error)]
pub enum InputError {
    /// The launcher cannot be reached.
    #[error("cannot reach the launcher of the run in {}: {source}; is the run still going on?", root.display())]
    Unreachable {
        /// The domain's directory.
        root: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The launcher's answer cannot be read.
    #[error("the launcher's answer is malformed: {reason}; are both programs of the same version?")]
    Malformed {
        /// The reason.
        reason: String,
    },
    /// The value is not one of the scenario.
    #[error(transparent)]
    Value(#[from] ConfigError),
    /// The loop would not converge.
    #[error(
        "with these values the loop of {body} does not converge: {reason}; force the change to set them all the same"
    )]
    Unstable {
        /// The driven body.
        body: String,
        /// The reason.
        reason: String,
    },
    /// The launcher refused.
    #[error("{reason}")]
    Refused {
        /// The stable code of the reason.
        code: String,
        /// The reason.
        reason: String,
    },
}

impl InputError {
    /// Returns the stable code of the error.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Unreachable { .. } => "no-launcher",
            Self::Malformed { .. } => "malformed",
            Self::Value(error) => error.mistakes().first().map_or("malformed", |(_, code)| code),
            Self::Unstable { .. } => "unstable-loop",
            Self::Refused { code, .. } => CODES.into_iter().find(|known| known == code).unwrap_or("refused"),
        }
    }
}

impl From<Answer> for InputError {
    /// Returns the error of an answer that is not the expected one.
    fn from(answer: Answer) -> Self {
        match answer {
            Answer::Refused { code, reason } => Self::Refused { code, reason },
            _ => Self::Malformed { reason: "it answers another request".to_owned() },
        }
    }
}

/// Changes inputs of the run in a domain's directory, all at the same tick: checks the values against the run's scenario and its
/// present values, then asks the launcher. `force` allows values with which the loop does not converge.
///
/// # Errors
/// [`InputError`].
pub fn change(
    root: &Path,
    mut changes: Vec<WantedChange>,
    at_tick: Option<u64>,
    force: bool,
) -> Result<Answer, InputError> {
    let scenario = scenario_of(root)?;
    for change in &mut changes {
        let refused = |reason| InputError::Refused { code: "not-tunable".to_owned(), reason };
        let (_, info) = scenario.inputs.find(&change.key).map_err(refused)?;
        change.key.clone_from(&info.key);
        if !change.ramp_s.is_finite() {
            let reason = "the length of a ramp is out of range; give 0 s or more".to_owned();
            return Err(InputError::Refused { code: "out-of-range".to_owned(), reason });
        }
    }
    let (_, values) = current(root)?;
    Tuned::new(&scenario, &values)?.check(&changes, force)?;
    request(root, &Request::Set { changes, at_tick })
}

/// Sends a request to the launcher of the run in a domain's directory.
///
/// # Errors
/// [`InputError`]; a refusal is an error.
pub fn request(root: &Path, request: &Request) -> Result<Answer, InputError> {
    let unreachable = |source| InputError::Unreachable { root: root.to_owned(), source };
    let exchange = || {
        let mut stream = UnixStream::connect(socket_path(root))?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        writeln!(stream, "{}", serde_json::to_string(request)?)?;
        let mut line = String::new();
        BufReader::new(stream.take(LINE_MAX * 16)).read_line(&mut line)?;
        Ok(line)
    };
    let line: String = exchange().map_err(unreachable)?;
    if line.is_empty() {
        return Err(unreachable(io::ErrorKind::UnexpectedEof.into()));
    }
    match serde_json::from_str(&line) {
        Ok(refusal @ Answer::Refused { .. }) => Err(refusal.into()),
        Ok(answer) => Ok(answer),
        Err(error) => Err(InputError::Malformed { reason: error.to_string() }),
    }
}

/// Returns the values of all inputs of a run, and their tick.
///
/// # Errors
/// [`InputError`].
pub fn current(root: &Path) -> Result<(u64, BTreeMap<String, Value>), InputError> {
    match request(root, &Request::Get)? {
        Answer::Values { tick, values } => Ok((tick, values)),
        answer => Err(answer.into()),
    }
}

/// A scenario with other values of its inputs.
pub struct Tuned {
    document: Document,
}

impl Tuned {
    /// Starts from the scenario of a run and the present values of its inputs.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn new(scenario: &Scenario, values: &BTreeMap<String, Value>) -> Result<Self, ConfigError> {
        // The scripted changes are over, or still come.
        let mut document = Document::parse(&scenario.to_toml(), &scenario.name)?.without("input");
        let place = "the run's present value".to_owned().into();
        values.iter().try_for_each(|(key, value)| document.put(key, value.clone(), &place))?;
        Ok(Self { document })
    }

    /// Checks that the scenario with these changes is valid, and, unless `force`, that its loops converge as far as they can be
    /// analysed: a loop that had no rate before need not have one.
    ///
    /// # Errors
    /// [`InputError::Value`], [`InputError::Unstable`].
    pub fn check(mut self, changes: &[WantedChange], force: bool) -> Result<(), InputError> {
        let before = Scenario::resolve(self.document.clone())?;
        for change in changes {
            let place = format!("{}={}", change.key, change.value).into();
            self.document.put(&change.key, change.value.clone(), &place)?;
        }
        let after = Scenario::resolve(self.document)?;
        if force || !changes.iter().any(|change| after.inputs.is_parameter(&change.key)) {
            return Ok(());
        }
        let had_rate: Vec<bool> = claims(&before).iter().map(|claim| claim.loop_rate_per_s.is_some()).collect();
        let lost =
            claims(&after).into_iter().zip(had_rate).find(|(claim, had)| *had && claim.loop_rate_per_s.is_none());
        match lost {
            Some((claim, _)) => {
                Err(InputError::Unstable { body: claim.body, reason: claim.reason.unwrap_or_default() })
            }
            None => Ok(()),
        }
    }
}
