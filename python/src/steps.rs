//! A loop in one thread, stepped by its controller.

use crate::inputs::{refused, value};
use crate::run::{failed, scenario};
use crate::seat::{Seat, seat_of};
use corotate::launch::{Claim, Summary, claim, make_directory, make_latest, new_run, write_run};
use corotate::sample::{FieldKind, Stamp, status};
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::PathBuf;
use std::time::SystemTime;

/// Words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// The result of a step: the command that acts, the numbers of rejected and missed commands, and how a body's motion has ended.
type Acted<'py> = (Bound<'py, PyArray1<f64>>, u32, u32, Option<String>);
type Stepped<'py> = (Bound<'py, PyArray1<f64>>, f64, bool, Option<Acted<'py>>);

/// A run that is stepped. What is observed is every number of the estimate, then of each driven body's measurement; an action is the
/// first field of each command.
#[pyclass(unsendable)]
pub struct Steps {
    steps: Option<corotate::launch::Steps>,
    /// Again, for the summary.
    scenario: corotate::scenario::Scenario,
    /// Of each input, where its numbers are: first word and count.
    numbers: Vec<Vec<(usize, usize)>>,
    commands: Vec<Vec<u64>>,
    /// Of each command, how many numbers its first field has, and its body.
    actions: Vec<usize>,
    driven: Vec<String>,
    observation: Vec<f64>,
    over: bool,
    started: SystemTime,
    /// The directory of the results, if they are kept.
    results: Option<(PathBuf, Claim)>,
}

impl Steps {
    fn steps(&mut self) -> PyResult<&mut corotate::launch::Steps> {
        self.steps.as_mut().ok_or_else(|| failed("the run has been finished"))
    }

    /// Observes the next tick, and keeps what was seen of what is missing.
    fn observe(&mut self) -> PyResult<()> {
        let Some(steps) = &mut self.steps else { return Err(failed("the run has been finished")) };
        self.over = !steps.observe().map_err(failed)?;
        let mut at = 0;
        for (input, numbers) in steps.inputs().iter().zip(&self.numbers) {
            for (first, count) in numbers {
                if let Some(words) = input.as_ref().filter(|_| !self.over) {
                    for (seen, word) in self.observation[at..].iter_mut().zip(&words[*first..first + count]) {
                        *seen = f64::from_bits(*word);
                    }
                }
                at += count;
            }
        }
        Ok(())
    }
}

#[pymethods]
impl Steps {
    #[new]
    fn new(given: &str, kind: &str, overrides: Vec<String>) -> PyResult<Self> {
        let scenario_again = || scenario(given, kind, &overrides);
        let steps = corotate::launch::Steps::new(scenario_again()?).map_err(failed)?;
        let mut scenario = scenario_again()?;
        scenario.inputs.receive_in(steps.received());
        scenario.run = Some(new_run().map_err(failed)?);
        let ports = corotate::runtime::ports(&scenario, corotate::runtime::RoleId::Controller);
        let numbers = |port: &corotate::bus::Port| {
            let numbers = port.fields.iter().filter(|field| field.kind == FieldKind::F64);
            numbers.map(|field| (field.offset / size_of::<u64>(), field.count)).collect::<Vec<_>>()
        };
        let numbers: Vec<Vec<(usize, usize)>> = ports.reads.iter().map(numbers).collect();
        let length = numbers.iter().flatten().map(|(_, count)| count).sum();
        let mut this = Self {
            steps: Some(steps),
            scenario,
            numbers,
            commands: ports.writes.iter().map(|port| vec![0; port.size / size_of::<u64>() - STAMP]).collect(),
            actions: ports.writes.iter().map(|port| port.fields.first().map_or(0, |field| field.count)).collect(),
            driven: ports.writes.iter().map(|port| port.topic.body.clone()).collect(),
            observation: vec![0.0; length],
            over: false,
            started: SystemTime::now(),
            results: None,
        };
        this.observe()?;
        Ok(this)
    }

    /// Layouts of what the controller reads and writes.
    fn seat(&self) -> PyResult<Seat> {
        seat_of(&self.scenario, "controller")
    }

    /// The observation of the current tick.
    fn observation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.observation)
    }

    /// Returns true after the last tick.
    fn over(&self) -> bool {
        self.over
    }

    /// The current tick.
    fn tick(&mut self) -> PyResult<u64> {
        self.steps().map(|steps| steps.tick())
    }

    /// Acts at the current tick and observes the next: the observation, the metric of the tick, whether it was the last, and, unless
    /// it was, what the bodies did with their commands.
    fn step<'py>(&mut self, py: Python<'py>, action: PyReadonlyArray1<'py, f64>) -> PyResult<Stepped<'py>> {
        let action = action.as_slice()?;
        let length: usize = self.actions.iter().sum();
        if action.len() != length {
            return Err(PyValueError::new_err(format!("an action has {length} numbers, not {}", action.len())));
        }
        let mut rest = action;
        for (command, count) in self.commands.iter_mut().zip(&self.actions) {
            let (own, following) = rest.split_at(*count);
            command.iter_mut().zip(own).for_each(|(word, value)| *word = value.to_bits());
            rest = following;
        }
        self.act_and_observe()?;
        let metric = self.steps()?.metric();
        let (observation, over) = (self.observation(py), self.over);
        let (mut applied, mut rejected, mut missed, mut loss) = (Vec::with_capacity(length), 0, 0, None);
        for body in self.steps()?.bodies() {
            if let (None, Some(end)) = (&loss, body.loss) {
                loss = Some(format!("{} {end}", body.body));
            }
        }
        for name in &self.driven {
            let Some(body) = self.steps.iter().flat_map(|steps| steps.bodies()).find(|body| body.body == *name) else {
                continue;
            };
            applied.extend_from_slice(&body.applied);
            rejected += u32::from(body.status & status::REJECTED != 0);
            missed += u32::from(body.status & (status::HOLDING | status::SAFE) != 0);
        }
        let acted = (!over).then(|| (PyArray1::from_vec(py, applied), rejected, missed, loss));
        Ok((observation, metric, over, acted))
    }

    /// The same with whole commands, as bytes without their stamps.
    fn act(&mut self, commands: Vec<Vec<u8>>) -> PyResult<bool> {
        if commands.len() != self.commands.len() {
            return Err(PyValueError::new_err(format!(
                "there are {} commands, not {}",
                self.commands.len(),
                commands.len()
            )));
        }
        for (command, bytes) in self.commands.iter_mut().zip(&commands) {
            for (word, bytes) in command.iter_mut().zip(bytes.chunks_exact(size_of::<u64>())) {
                *word = u64::from_ne_bytes(bytes.try_into().unwrap_or_default());
            }
        }
        self.act_and_observe()?;
        Ok(!self.over)
    }

    /// The samples that the controller has, as bytes without their stamps; none where one is missing.
    fn inputs(&mut self) -> PyResult<Vec<Option<Vec<u8>>>> {
        let content = |words: &Vec<u64>| words[STAMP..].iter().flat_map(|word| word.to_ne_bytes()).collect();
        Ok(self.steps()?.inputs().iter().map(|input| input.as_ref().map(content)).collect())
    }

    /// The physical bounds that samples are held against, by name: of measurements, estimates, commands.
    fn limits(&self) -> Vec<(String, f64)> {
        self.scenario.rig.limits().into_iter().map(|limit| (limit.name, limit.value)).collect()
    }

    /// Changes an input, to a value in TOML, from the next tick on, and returns this tick.
    fn set_input(&mut self, key: &str, text: &str) -> PyResult<u64> {
        let value = value(text)?;
        self.steps()?.set_input(key, &value).map_err(refused)
    }

    /// Names the directory for the results, before the first tick.
    fn claim(&mut self, out: Option<PathBuf>, overwrite: bool) -> PyResult<()> {
        let directory = make_directory(out.as_deref(), &self.scenario.name, self.started).map_err(failed)?;
        let run = self.scenario.run.ok_or_else(|| failed("the run has no identifier"))?;
        let claim = claim(&directory, run, overwrite).map_err(failed)?;
        self.results = Some((directory, claim));
        Ok(())
    }

    /// Ends the run, and gives its summary as JSON; its results are written to the directory that was named.
    fn finish(&mut self) -> PyResult<(String, Option<PathBuf>)> {
        let steps = self.steps.take().ok_or_else(|| failed("the run has been finished"))?;
        let outcome = steps.finish().map_err(failed)?;
        let summary = Summary::new(&self.scenario, &outcome, self.started);
        let directory = match self.results.take() {
            Some((directory, _claim)) => {
                write_run(&directory, &self.scenario, &summary, outcome.late.as_ref()).map_err(failed)?;
                let _ = make_latest(&directory);
                Some(directory)
            }
            None => None,
        };
        Ok((serde_json::to_string(&summary).map_err(failed)?, directory))
    }
}

impl Steps {
    fn act_and_observe(&mut self) -> PyResult<()> {
        if self.over {
            return Err(failed("the run is over; begin another"));
        }
        let commands: Vec<&[u64]> = self.commands.iter().map(Vec::as_slice).collect();
        let Some(steps) = &mut self.steps else { return Err(failed("the run has been finished")) };
        steps.act(&commands).map_err(failed)?;
        self.observe()
    }
}
