//! A run that another process steps, as its controller, by messages: the commands `step` of every program and the package for Python.
//!
//! A request is one byte, the operation, and its content; an answer is one byte, 0 or 1 for an error, and its content. Words are of
//! eight bytes in the machine's order; samples are words without their stamps. Must not decide anything for the controller.
//!
//! | operation | content | answer |
//! |---|---|---|
//! | `b` begin | JSON: `Begin` | JSON: the controller's seat, the limits of its samples, the numbers of the state of each role |
//! | `o` observe | | the samples (`SteppedRun::observe`) of the first tick |
//! | `a` act | the words of each command | the samples of the next tick |
//! | `s` state | | numbers |
//! | `r` replace the state | numbers | |
//! | `i` input | JSON: key, and value in TOML | JSON: the tick from which it acts |
//! | `c` commands | JSON: `Own` | the words of each command of the scenario's own controller, turn by turn, in a run of its own |
//! | `f` finish | | JSON: the summary, and the directory of the results or null |
//!
//! An error is JSON: `invalid` if the scenario is, and `errors`, each a text and a code.

use super::results::{Claim, claim, make_directory, make_latest, new_run};
use super::steps::Steps;
use super::summary::{Summary, write_run};
use crate::config::{ClockKind, ConfigError};
use crate::failure::Failure;
use crate::runtime::{RoleId, ports};
use crate::sample::{Stamp, status};
use crate::scenario::Scenario;
use crate::seat::describe_seat;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::SystemTime;

/// Length of a stamp, words.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// The form of a scenario in a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScenarioKind {
    /// The name of one that ships with the program.
    Name,
    /// The path of a file.
    Path,
    /// Its text.
    Text,
}

/// A request to begin a run.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Begin {
    scenario: String,
    kind: ScenarioKind,
    set: Vec<String>,
    /// The results are kept: in `out`, or else in a new directory under `runs/`.
    keep: bool,
    out: Option<PathBuf>,
    overwrite: bool,
    /// The rig is the ideal one, without noise and rounding of its sensors.
    ideal: bool,
}

/// A request for the commands of the scenario's own controller.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Own {
    begin: Begin,
    turns: u64,
}

/// Reads a scenario in its form, with overrides.
pub type LoadScenario<'a> = dyn Fn(&str, ScenarioKind, &[String]) -> Result<Scenario, ConfigError> + 'a;

/// A process that steps runs, one after the other.
pub struct StepSession<'a> {
    load: Box<LoadScenario<'a>>,
    run: Option<SteppedRun>,
}

struct SteppedRun {
    steps: Steps,
    /// Again, for the summary.
    scenario: Scenario,
    commands: Vec<Vec<u64>>,
    /// Length of each input, words.
    input_words: Vec<usize>,
    driven: Vec<String>,
    is_over: bool,
    started: SystemTime,
    /// The directory of the results, if they are kept.
    results: Option<(PathBuf, Claim)>,
}

/// The error of a request; `invalid` if the scenario is.
struct RequestError {
    invalid: bool,
    failure: Failure,
}

impl<E: Into<Failure>> From<E> for RequestError {
    fn from(error: E) -> Self {
        Self { invalid: false, failure: error.into() }
    }
}

impl RequestError {
    fn invalid(error: ConfigError) -> Self {
        Self { invalid: true, failure: error.into() }
    }

    fn to_json(&self) -> Value {
        let errors: Vec<Value> =
            self.failure.0.iter().map(|(text, code)| json!({ "text": text, "code": code })).collect();
        json!({ "invalid": self.invalid, "errors": errors })
    }
}

type Answer = Result<Vec<u8>, RequestError>;

fn malformed(reason: impl std::fmt::Display) -> Failure {
    Failure::new("malformed", format!("the request cannot be read: {reason}; use programs of the same version"))
}

impl<'a> StepSession<'a> {
    /// Creates a session without a run.
    pub fn new(load: impl Fn(&str, ScenarioKind, &[String]) -> Result<Scenario, ConfigError> + 'a) -> Self {
        Self { load: Box::new(load), run: None }
    }

    /// Answers a request.
    pub fn answer(&mut self, request: &[u8]) -> Vec<u8> {
        let answer = match request.split_first() {
            Some((b'b', content)) => self.begin(content),
            Some((b'c', content)) => self.own_commands(content),
            Some((operation, content)) => self.in_run(*operation, content),
            None => Err(malformed("it is empty").into()),
        };
        let (first, content) = match answer {
            Ok(content) => (0, content),
            Err(error) => (1, error.to_json().to_string().into_bytes()),
        };
        [&[first], &content[..]].concat()
    }

    fn in_run(&mut self, operation: u8, content: &[u8]) -> Answer {
        if operation == b'f' {
            let run = self.run.take().ok_or_else(no_run)?;
            return run.finish();
        }
        let run = self.run.as_mut().ok_or_else(no_run)?;
        match operation {
            b'o' => run.observe(),
            b'a' => run.act(content),
            b's' => Ok(run.state().iter().flat_map(|number| number.to_ne_bytes()).collect()),
            b'r' => run.set_state(&words(content)?).map(|()| Vec::new()),
            b'i' => {
                let (key, text): (String, String) = serde_json::from_slice(content).map_err(malformed)?;
                let tick = run.steps.set_input(&key, &toml_value(&text)?);
                let tick = tick.map_err(|error| Failure::new(error.code(), &error))?;
                Ok(json!(tick).to_string().into_bytes())
            }
            _ => Err(malformed(format_args!("there is no operation {operation}")).into()),
        }
    }

    fn scenario(&self, begin: &Begin) -> Result<Scenario, RequestError> {
        let loaded = (self.load)(&begin.scenario, begin.kind, &begin.set);
        let mut scenario = loaded.map_err(RequestError::invalid)?;
        if begin.ideal {
            scenario.rig = scenario.rig.ideal();
        }
        Ok(scenario)
    }

    fn own_commands(&self, content: &[u8]) -> Answer {
        let own: Own = serde_json::from_slice(content).map_err(malformed)?;
        let words = Steps::own_commands(self.scenario(&own.begin)?, own.turns)?;
        Ok(words.iter().flat_map(|word| word.to_ne_bytes()).collect())
    }

    fn begin(&mut self, content: &[u8]) -> Answer {
        let begin: Begin = serde_json::from_slice(content).map_err(malformed)?;
        let (mut steps, mut scenario) = (Steps::new(self.scenario(&begin)?)?, self.scenario(&begin)?);
        let id = new_run().map_err(|error| Failure::new("no-random-numbers", error))?;
        scenario.clock = ClockKind::InProcess;
        scenario.inputs.receive_in(steps.received());
        scenario.run = Some(id);
        let started = SystemTime::now();
        let results = match begin.keep {
            false => None,
            true => {
                let directory = make_directory(begin.out.as_deref(), &scenario.name, started)
                    .map_err(|error| Failure::new("cannot-use-directory", error))?;
                let claimed = claim(&directory, id, begin.overwrite)?;
                Some((directory, claimed))
            }
        };
        let seat = serde_json::to_value(describe_seat(&scenario, RoleId::Controller, None));
        let limits: Vec<_> = scenario.rig.limits().into_iter().map(|limit| (limit.name, limit.value)).collect();
        let state: Vec<_> = steps.state().into_iter().map(|(role, numbers)| (role.to_owned(), numbers.len())).collect();
        let description = json!({
            "seat": seat.map_err(malformed)?,
            "limits": limits,
            "state": state,
        });
        let (outputs, reads) = (steps.outputs(), ports(&scenario, RoleId::Controller).reads);
        self.run = Some(SteppedRun {
            commands: outputs.iter().map(|port| vec![0; port.size / size_of::<u64>() - STAMP]).collect(),
            input_words: reads.iter().map(|port| port.size / size_of::<u64>() - STAMP).collect(),
            driven: outputs.iter().map(|port| port.topic.body.clone()).collect(),
            is_over: false,
            steps,
            scenario,
            started,
            results,
        });
        Ok(description.to_string().into_bytes())
    }
}

impl SteppedRun {
    /// Observes the next tick. The samples are words: 1 after the last tick; the tick; the metric; the numbers of rejected and missed
    /// commands; the number of components of the applied commands, and these; 1 for each input that is present; the samples of all
    /// inputs, zero where one is missing; the values of the seat's `values`. The end of a body's motion follows as text.
    fn observe(&mut self) -> Answer {
        self.is_over = !self.steps.observe()?;
        let (mut applied, mut rejected, mut missed) = (Vec::new(), 0, 0);
        for name in &self.driven {
            let Some(body) = self.steps.bodies().find(|body| body.body == *name) else { continue };
            applied.extend(body.applied.iter().map(|number| number.to_bits()));
            rejected += u64::from(body.status & status::REJECTED != 0);
            missed += u64::from(body.status & (status::HOLDING | status::SAFE) != 0);
        }
        let metric = self.steps.metric().to_bits();
        let mut words =
            vec![u64::from(self.is_over), self.steps.tick(), metric, rejected, missed, applied.len() as u64];
        words.extend(applied);
        let present = |input: &Option<Vec<u64>>| input.as_ref().filter(|_| !self.is_over).is_some();
        words.extend(self.steps.inputs().iter().map(|input| u64::from(present(input))));
        for (input, size) in self.steps.inputs().iter().zip(&self.input_words) {
            match input.as_ref().filter(|_| !self.is_over) {
                Some(sample) => words.extend_from_slice(&sample[STAMP..]),
                None => words.resize(words.len() + size, 0),
            }
        }
        words.extend(self.steps.values().iter().map(|value| value.to_bits()));
        let lost = self.steps.bodies().find_map(|body| body.loss.map(|end| format!("{} {end}", body.body)));
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_ne_bytes()).collect();
        bytes.extend_from_slice(lost.unwrap_or_default().as_bytes());
        Ok(bytes)
    }

    fn act(&mut self, content: &[u8]) -> Answer {
        if self.is_over {
            return Err(Failure::new("run-over", "the run is over; begin another").into());
        }
        let words = words(content)?;
        let length: usize = self.commands.iter().map(Vec::len).sum();
        if words.len() != length {
            let reason = format!("the commands have {length} words, not {}", words.len());
            return Err(Failure::new("wrong-length", reason).into());
        }
        let mut rest = &words[..];
        for command in &mut self.commands {
            let (own, following) = rest.split_at(command.len());
            command.copy_from_slice(own);
            rest = following;
        }
        let commands: Vec<&[u64]> = self.commands.iter().map(Vec::as_slice).collect();
        self.steps.act(&commands)?;
        self.observe()
    }

    fn state(&mut self) -> Vec<f64> {
        self.steps.state().into_iter().flat_map(|(_, numbers)| numbers).collect()
    }

    fn set_state(&mut self, words: &[u64]) -> Result<(), RequestError> {
        let length = self.state().len();
        if words.len() != length {
            let reason = format!("the state has {length} numbers, not {}", words.len());
            return Err(Failure::new("wrong-length", reason).into());
        }
        self.steps.set_state(&words.iter().map(|word| f64::from_bits(*word)).collect::<Vec<_>>());
        Ok(())
    }

    /// Ends the run and writes its results, if they are kept.
    fn finish(self) -> Answer {
        let outcome = self.steps.finish()?;
        let summary = Summary::new(&self.scenario, &outcome, self.started);
        let directory = self.results.as_ref().map(|(directory, _)| directory);
        if let Some(directory) = directory {
            let written = write_run(directory, &self.scenario, &summary, outcome.late.as_ref());
            written.map_err(|error| Failure::new("cannot-write", format!("cannot write the results: {error}")))?;
            let _ = make_latest(directory);
        }
        Ok(json!({ "summary": summary, "directory": directory }).to_string().into_bytes())
    }
}

fn no_run() -> Failure {
    Failure::new("run-over", "no run is under way; begin another")
}

/// Returns the words of a content.
fn words(content: &[u8]) -> Result<Vec<u64>, Failure> {
    let (words, rest) = content.as_chunks::<8>();
    match rest {
        [] => Ok(words.iter().map(|word| u64::from_ne_bytes(*word)).collect()),
        _ => Err(malformed("its length is not a number of words")),
    }
}

/// Reads the TOML of a value.
fn toml_value(text: &str) -> Result<toml::Value, Failure> {
    let table: Result<toml::Table, _> = toml::from_str(&format!("value = {text}"));
    let value = table.ok().and_then(|mut table| table.remove("value"));
    value.ok_or_else(|| {
        Failure::new("no-value", format!("{text} is not a value; give a number, a list of numbers, or true or false"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    fn session() -> StepSession<'static> {
        StepSession::new(|text, kind, set| {
            assert_eq!(kind, ScenarioKind::Text);
            Scenario::parse(text, "test", set)
        })
    }

    fn begin(session: &mut StepSession<'_>, set: &[&str]) -> Vec<u8> {
        let begin = json!({
            "scenario": SHIPPED[0].1, "kind": "text", "set": set, "keep": false, "out": null, "overwrite": false,
            "ideal": false,
        });
        session.answer(&[b"b", begin.to_string().as_bytes()].concat())
    }

    fn code(answer: &[u8]) -> (bool, String) {
        assert_eq!(answer[0], 1, "an error");
        let error: Value = serde_json::from_slice(&answer[1..]).unwrap();
        (error["invalid"] == true, error["errors"][0]["code"].as_str().unwrap().to_owned())
    }

    #[test]
    fn a_wrong_request_is_an_error_with_its_code_and_the_run_goes_on() {
        let mut session = session();
        for request in [&b""[..], b"o", b"a", b"f", b"x", b"b{}", b"c{}", b"\xff\xff"] {
            let (invalid, code) = code(&session.answer(request));
            assert!(!invalid && ["malformed", "run-over"].contains(&&*code), "{request:?}: {code}");
        }
        assert_eq!(code(&begin(&mut session, &["duration_s=-1"])), (true, "out-of-range".to_owned()));
        assert_eq!(begin(&mut session, &["duration_s=1", "accept={}"])[0], 0);
        assert_eq!(session.answer(b"o")[0], 0);
        for (request, expected) in [
            (&b"a1234567"[..], "malformed"),
            (b"a12345678", "wrong-length"),
            (b"r12345678", "wrong-length"),
            (b"i[\"no.such\", \"1\"]", "not-tunable"),
            (b"i[\"seed\", \"[\"]", "no-value"),
            (b"x", "malformed"),
        ] {
            assert_eq!(code(&session.answer(request)), (false, expected.to_owned()), "{request:?}");
        }
        assert_eq!(session.answer(&[&b"a"[..], &vec![0; 8 * session_words()]].concat())[0], 0);
        let done = session.answer(b"f");
        let summary: Value = serde_json::from_slice(&done[1..]).unwrap();
        assert!(summary["summary"]["books"]["balanced"] == true && summary["directory"].is_null());
    }

    /// Two loops of different pasts have the same samples and states from the tick on at which one takes the other's state.
    #[test]
    fn a_state_determines_the_next_ones_also_with_commands_in_flight() {
        for delay in [1, 3] {
            let command = |value: f64| {
                let mut words = vec![0_u64; session_words()];
                words[..3].fill(value.to_bits());
                let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_ne_bytes()).collect();
                [b"a", &bytes[..]].concat()
            };
            let run = |factor: f64| {
                let mut session = session();
                let delay = format!("actuation_delay_ticks={delay}");
                assert_eq!(begin(&mut session, &["duration_s=1", "accept={}", "limits={}", &delay])[0], 0);
                assert_eq!(session.answer(b"o")[0], 0);
                (0..20).for_each(|tick| assert_eq!(session.answer(&command(factor * f64::from(tick)))[0], 0));
                session
            };
            let (mut first, mut second) = (run(0.1), run(-0.2));
            let state = first.answer(b"s");
            assert!(second.answer(b"s") != state && state.len() > 8 * 12);
            assert_eq!(second.answer(&[b"r", &state[1..]].concat()), [0]);
            assert_eq!(second.answer(b"s"), state);
            for tick in 20..30 {
                let step = command(f64::from(tick));
                let (seen, expected) = (second.answer(&step), first.answer(&step));
                // All but the metric, which is still that of the truths from before the change.
                let words = seen[1..].chunks(8).zip(expected[1..].chunks(8));
                let different: Vec<usize> =
                    words.enumerate().filter(|(_, (a, b))| a != b).map(|(word, _)| word).collect();
                assert!(different.iter().all(|word| *word == 2), "delay {delay}, tick {tick}: words {different:?}");
                assert!(tick == 20 || different.is_empty(), "delay {delay}, tick {tick}");
                assert_eq!(first.answer(b"s"), second.answer(b"s"), "delay {delay}, tick {tick}");
            }
        }
    }

    fn session_words() -> usize {
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &[]).unwrap();
        let writes = ports(&scenario, RoleId::Controller).writes;
        writes.iter().map(|port| port.size / size_of::<u64>() - STAMP).sum()
    }
}
