//! Campaign files: text as typed, then a [`Campaign`] as resolved, which yields any case.
//!
//! Every error names file, line and key, the reason and the remedy. Must not run anything.

use super::apply::{EVERY, fault_that_is_off, put};
use super::axis::{RawAxis, Varied};
use super::draw::{self, SOBOL_AXES, SOBOL_POINTS};
use super::margin::{RawMargin, Searched};
use super::table::{Metric, Parameter, Statistic, Table};
use crate::config::{Checks, ClockKind, ConfigError, Document, is_name, read_text};
use crate::fault;
use crate::scenario::Scenario;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fs::File;
use std::path::Path;
use toml::Value;
use xxhash_rust::xxh3::xxh3_64;

/// Upper bound on the cases of a campaign.
const MAX_CASES: u64 = 1_000_000_000;
/// Number of cases of which one must be valid.
const TRIED: u64 = 64;
/// Bits of a case's seed: every program that reads tables can represent them.
pub(super) const SEED_BITS: u32 = 53;
/// The table of a campaign that contains its scenario.
const SCENARIO: &str = "scenario";
/// Returns the text of the shipped scenario of a name, or an error.
pub type Shipped<'a> = &'a dyn Fn(&str) -> Result<Cow<'static, str>, ConfigError>;

/// A campaign: a scenario, its varied keys, and their values.
#[derive(Debug, Clone)]
pub struct Campaign {
    name: String,
    base: String,
    document: Document,
    axes: Vec<Varied>,
    samples: Option<(Sampling, u64)>,
    repeats: u64,
    seed: u64,
    rate: bool,
    margins: Vec<Searched>,
    cases: u64,
    metrics: Vec<Metric>,
    resolved: String,
}

/// One case: its number, seed and values.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// The number, from 0.
    pub number: u64,
    /// The scenario's seed.
    pub seed: u64,
    /// The values of the axes, as tables show them.
    pub parameters: Vec<Parameter>,
    values: Vec<Value>,
}

/// The method by which samples are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Sampling {
    #[default]
    Random,
    LatinHypercube,
    Sobol,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Raw {
    name: String,
    base: String,
    #[serde(default = "default_one")]
    pub seed: u64,
    #[serde(default = "default_one")]
    repeats: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sampling: Option<Sampling>,
    #[serde(default)]
    rate: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub axis: Vec<RawAxis>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    margin: Vec<RawMargin>,
}

fn default_one() -> u64 {
    1
}

/// Returns true if a document is a campaign, not a scenario.
pub(crate) fn is_campaign(document: &Document) -> bool {
    document.has("base") && !document.has("rig")
}

impl Campaign {
    /// Reads a file; paths of scenarios in it are relative to its directory.
    ///
    /// # Errors
    /// [`ConfigError`], with the place, the reason and the remedy.
    pub fn load(path: &Path, overrides: &[String], shipped: Shipped<'_>) -> Result<Self, ConfigError> {
        Self::from_document(Document::read(path)?, overrides, shipped)
    }

    /// Like [`load`](Self::load), from a text; `origin` stands for the file in error messages.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn parse(text: &str, origin: &str, overrides: &[String], shipped: Shipped<'_>) -> Result<Self, ConfigError> {
        Self::from_document(Document::parse(text, origin)?, overrides, shipped)
    }

    /// Like [`load`](Self::load), from a document; `overrides` change the scenario, as `--set` does.
    pub(crate) fn from_document(
        mut file: Document,
        overrides: &[String],
        shipped: Shipped<'_>,
    ) -> Result<Self, ConfigError> {
        // The scenario's part is checked with the scenario.
        let (inner, set) = (file.take(SCENARIO), file.take("set"));
        let mut lists = file.split_off(&["fault", "input"]);
        let raw: Raw = file.read_into()?;
        let mut document = match inner {
            Some(inner) => inner,
            None => base(&raw.base, &file, shipped)?,
        };
        ["fault", "input"].into_iter().for_each(|key| document.append(key, &mut lists));
        if let Some(set) = set {
            merge(&mut document, &set)?;
        }
        overrides.iter().try_for_each(|argument| document.set(argument))?;
        let mut checks = Checks::new(&file);
        check(&raw, &mut checks);
        let axes: Vec<Option<Varied>> =
            raw.axis.iter().enumerate().map(|(index, axis)| Varied::resolve(axis, index, &file, &mut checks)).collect();
        check_keys(&raw, &mut checks);
        let resolved = axes.iter().flatten().cloned().collect::<Vec<_>>();
        for (index, axis) in axes.iter().enumerate() {
            let drawn = axis.as_ref().is_some_and(|axis| axis.points().is_none());
            let asked = raw.samples.is_some() || raw.axis[index].range.is_none();
            checks.require(!drawn || asked, &format!("axis[{index}].range.points"), "missing-key", || {
                "is missing; add it, or draw from the range with samples = N".to_owned()
            });
        }
        let margin =
            |(index, margin): (usize, &RawMargin)| Searched::resolve(margin, index, &file, &resolved, &mut checks);
        let margins: Vec<Searched> = raw.margin.iter().enumerate().filter_map(margin).collect();
        let mut points = resolved.iter().map(|axis| axis.points().unwrap_or(1));
        let points = raw.samples.or_else(|| points.try_fold(1_u64, u64::checked_mul));
        let cases = points.and_then(|points| points.checked_mul(raw.repeats)).filter(|cases| *cases <= MAX_CASES);
        checks.require(cases.is_some(), "name", "too-many-cases", || {
            format!("has more than {MAX_CASES} cases; take fewer values, or samples = N of them")
        });
        let cases = checks.finish(cases)?;
        let samples = raw.samples.map(|samples| (raw.sampling.unwrap_or_default(), samples));
        let mut campaign = Self {
            name: raw.name.clone(),
            base: raw.base.clone(),
            axes: resolved,
            samples,
            repeats: raw.repeats,
            seed: raw.seed,
            rate: raw.rate,
            margins,
            cases,
            metrics: Vec::new(),
            resolved: text(&raw, &document),
            document,
        };
        campaign.metrics = campaign.try_cases()?;
        Ok(campaign)
    }

    /// Returns the metrics of the first valid case among some.
    ///
    /// # Errors
    /// The error of the first case, if all are invalid: a key does not exist, or no case would run.
    fn try_cases(&self) -> Result<Vec<Metric>, ConfigError> {
        let tried = self.cases.min(TRIED);
        let mut first = None;
        // Spread over the campaign: neighbours have most in common.
        for index in 0..tried {
            let case = self.case((u128::from(index) * u128::from(self.cases) / u128::from(tried)) as u64);
            match self.scenario(&case.expect("it is one of the cases")) {
                Ok(scenario) => return Ok(metrics(&scenario)),
                Err(error) => first = first.or(Some(error)),
            }
        }
        Err(first.expect("a campaign has a case"))
    }

    /// Returns the campaign with other axes and samples.
    #[cfg(test)]
    pub(super) fn with_axes(self, axes: Vec<Varied>, samples: Option<(Sampling, u64)>, seed: u64) -> Self {
        Self { axes, samples, seed, cases: samples.map_or(self.cases, |(_, samples)| samples), ..self }
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the number of cases.
    pub fn cases(&self) -> u64 {
        self.cases
    }

    /// Returns true if the proven rate is computed for every case.
    pub(super) fn rate(&self) -> bool {
        self.rate
    }

    pub(super) fn metrics(&self) -> &[Metric] {
        &self.metrics
    }

    pub(super) fn margins(&self) -> &[Searched] {
        &self.margins
    }

    /// Returns the campaign as a file that contains its scenario and resolves to itself.
    pub fn to_toml(&self) -> &str {
        &self.resolved
    }

    /// Returns a hash of everything that determines the cases; the name of the file does not.
    pub fn identity(&self) -> String {
        format!("{:016x}", xxh3_64(self.resolved.as_bytes()))
    }

    /// Returns the table without rows.
    pub fn table(&self) -> Table {
        Table {
            name: self.name.clone(),
            base: self.base.clone(),
            axes: self.axes.iter().map(|varied| varied.axis.clone()).collect(),
            metrics: self.metrics.clone(),
            cases: self.cases,
            rows: Vec::new(),
            margins: self.margins.iter().map(|searched| searched.margin.clone()).collect(),
        }
    }

    /// Returns a case; `None` if the number is out of range.
    pub fn case(&self, number: u64) -> Option<Case> {
        if number >= self.cases {
            return None;
        }
        let mut seed = fault::seed(self.seed, number) >> (u64::BITS - SEED_BITS);
        let (mut values, mut parameters) = (Vec::new(), Vec::new());
        let sample = number / self.repeats;
        for (index, axis) in self.axes.iter().enumerate() {
            let (value, point) = match (self.samples, axis.points()) {
                (Some((Sampling::Random, _)), _) => axis.drawn(draw::independent(self.seed, index, sample)),
                (Some((Sampling::LatinHypercube, samples)), _) => {
                    axis.drawn(draw::latin_hypercube(self.seed, index, sample, samples))
                }
                (Some((Sampling::Sobol, _)), _) => axis.drawn(draw::sobol(self.seed, index, sample)),
                (None, None) => axis.drawn(draw::independent(self.seed, index, number)),
                (None, Some(points)) => {
                    let point = number / self.stride(index) % points;
                    (axis.at(point), Some(point))
                }
            };
            if let ("seed", Value::Integer(given)) = (axis.axis.key.as_str(), &value) {
                seed = u64::try_from(*given).unwrap_or(seed);
            }
            parameters.push(axis.shown(&value, point));
            values.push(value);
        }
        Some(Case { number, seed, parameters, values })
    }

    /// Returns the case at one of the [`points`](Self::points) of a margin: the one with the first value of the key, if the key is
    /// an axis.
    pub(super) fn case_at(&self, searched: &Searched, point: u64) -> Option<Case> {
        let moved = searched.axis.filter(|_| self.samples.is_none());
        let number = moved.map_or(point, |moved| {
            let stride = self.stride(moved);
            point / stride * stride * self.axes[moved].points().unwrap_or(1) + point % stride
        });
        self.case(number)
    }

    /// Returns the point of a margin that a case represents.
    pub(super) fn point(&self, searched: &Searched, case: u64) -> Option<u64> {
        let Some(moved) = searched.axis.filter(|_| self.samples.is_none()) else {
            return Some(case).filter(|case| *case < self.cases);
        };
        let stride = self.stride(moved);
        let round = stride * self.axes[moved].points().unwrap_or(1);
        Some(case / round * stride + case % stride).filter(|_| case < self.cases && case % round < stride)
    }

    /// Returns the number of cases between two values of an axis, if all combinations run.
    fn stride(&self, axis: usize) -> u64 {
        self.axes[axis + 1..].iter().map(|axis| axis.points().unwrap_or(1)).product::<u64>() * self.repeats
    }

    /// Returns the number of points of a margin.
    pub(super) fn points(&self, searched: &Searched) -> u64 {
        let moved = searched.axis.filter(|_| self.samples.is_none());
        self.cases / moved.and_then(|moved| self.axes[moved].points()).unwrap_or(1)
    }

    /// Returns the scenario of a case as a document with the values of the axes.
    pub(crate) fn document(&self, case: &Case) -> Result<Document, ConfigError> {
        self.document_with(case, None)
    }

    /// Like [`document`](Self::document), with a margin's key at a value.
    pub(super) fn document_with(
        &self,
        case: &Case,
        moved: Option<(&Searched, &Value)>,
    ) -> Result<Document, ConfigError> {
        let mut document = self.document.clone();
        let seed = i64::try_from(case.seed).expect("a seed has few bits");
        document.put("seed", Value::Integer(seed), &"the case's seed".into())?;
        for (index, (axis, value)) in self.axes.iter().zip(&case.values).enumerate() {
            if moved.is_none_or(|(searched, _)| searched.axis != Some(index)) {
                put(&mut document, &axis.axis.key, axis.factor, value, &axis.place)?;
            }
        }
        if let Some((searched, value)) = moved {
            let factor = searched.axis.is_some_and(|axis| self.axes[axis].factor);
            put(&mut document, &searched.margin.key, factor, value, &searched.place)?;
        }
        let keys = self.axes.iter().map(|axis| &axis.axis.key).chain(moved.map(|(searched, _)| &searched.margin.key));
        let mut off: Vec<usize> = keys.filter_map(|key| fault_that_is_off(&document, key)).collect();
        off.sort_unstable();
        off.dedup();
        off.iter().rev().for_each(|number| document.remove_element("fault", *number));
        Ok(document)
    }

    /// Returns the scenario of a case, to run in one thread.
    ///
    /// # Errors
    /// [`ConfigError`] if the values make an invalid scenario.
    pub fn scenario(&self, case: &Case) -> Result<Scenario, ConfigError> {
        resolved(self.document(case)?, ClockKind::InProcess)
    }
}

/// Resolves a document under a clock that replaces its own; nothing is recorded.
pub(super) fn resolved(mut document: Document, clock: ClockKind) -> Result<Scenario, ConfigError> {
    document.put("clock", clock.name().into(), &"a campaign's clock".into())?;
    document.put("record", false.into(), &"a campaign records nothing".into())?;
    Scenario::resolve(document)
}

/// Returns the scenario that a campaign varies.
fn base(name: &str, file: &Document, shipped: Shipped<'_>) -> Result<Document, ConfigError> {
    let refuse = |code, reason: String| ConfigError::invalid(file.place("base"), "base", code, reason);
    if is_name(name) {
        let text = shipped(name).map_err(|error| refuse("unknown-scenario", error.to_string()))?;
        return Document::parse(&text, &format!("{name}.toml"));
    }
    let path = file.directory().join(name);
    let text = File::open(&path).map_err(|error| {
        refuse("cannot-read-scenario", format!("{}: {error}; name a scenario file", path.display()))
    })?;
    Document::parse(&read_text(text, &path)?, &path.display().to_string())
}

/// Puts every value of a table of changes at its path.
fn merge(document: &mut Document, set: &Document) -> Result<(), ConfigError> {
    fn put(document: &mut Document, set: &Document, table: &toml::Table, path: &str) -> Result<(), ConfigError> {
        for (key, value) in table {
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            match value {
                Value::Table(inner) if !inner.is_empty() => put(document, set, inner, &path)?,
                value => document.put(&path, value.clone(), &set.place(&path))?,
            }
        }
        Ok(())
    }
    put(document, set, set.table(), "")
}

/// Returns the campaign as a file that needs no other.
fn text(raw: &Raw, document: &Document) -> String {
    let mut table = toml::Table::try_from(raw).expect("a campaign of plain values is TOML");
    table.insert(SCENARIO.to_owned(), Value::Table(document.table().clone()));
    toml::to_string(&table).expect("a campaign of plain values is TOML")
}

/// Returns the columns of a scenario's metrics.
fn metrics(scenario: &Scenario) -> Vec<Metric> {
    let columns = |metric: &'static str| {
        Statistic::ALL.map(|statistic| Metric {
            name: format!("{metric}.{}", statistic.name()),
            metric: metric.to_owned(),
            statistic,
        })
    };
    scenario.rig.metrics().into_iter().flat_map(columns).collect()
}

fn check(raw: &Raw, checks: &mut Checks<'_>) {
    let named = (1..=32).contains(&raw.name.len())
        && raw.name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(named, "name", "bad-name", || {
        format!("`{}` cannot name files; use 1 to 32 of a-z, 0-9 and -", raw.name)
    });
    checks.require((1..=MAX_CASES).contains(&raw.repeats), "repeats", "out-of-range", || {
        format!("{} is out of range; give 1 to {MAX_CASES} runs per point", raw.repeats)
    });
    let samples = raw.samples.unwrap_or(1);
    checks.require((1..=MAX_CASES).contains(&samples), "samples", "out-of-range", || {
        format!("{samples} is out of range; give 1 to {MAX_CASES} samples, or leave it out for all combinations")
    });
    checks.require(raw.sampling.is_none() || raw.samples.is_some(), "sampling", "unused-key", || {
        "needs samples, and all combinations are run; add samples = N, or remove it".to_owned()
    });
    if raw.sampling == Some(Sampling::Sobol) {
        checks.require(raw.axis.len() <= SOBOL_AXES, "sampling", "too-many-axes", || {
            format!(
                "Sobol's sequence supports {SOBOL_AXES} axes, and there are {}; use latin-hypercube",
                raw.axis.len()
            )
        });
        checks.require(samples <= SOBOL_POINTS, "samples", "out-of-range", || format!("give at most {SOBOL_POINTS}"));
    }
}

/// Checks that no key is varied twice, and that an axis of a table precedes the axes of its keys.
fn check_keys(raw: &Raw, checks: &mut Checks<'_>) {
    for (index, axis) in raw.axis.iter().enumerate() {
        let covers =
            |earlier: &&RawAxis| format!("{}.", earlier.key.trim()).starts_with(&format!("{}.", axis.key.trim()));
        let key = format!("axis[{index}].key");
        if let Some(earlier) = raw.axis[..index].iter().find(covers) {
            checks.refuse(
                &key,
                "varied-twice",
                format!("`{}` is varied by an earlier axis; move that axis after this one", earlier.key),
            );
        }
        let every = axis.key.trim().ends_with(EVERY);
        checks.require(!every || axis.factor, &key, "not-a-factor", || {
            format!("`{}` stands for every number of a table, which needs factor = true; add it", axis.key)
        });
    }
}

impl Searched {
    /// Returns the parameters of a case that a margin does not move.
    pub(super) fn parameters(&self, case: &Case) -> Vec<Option<Parameter>> {
        let kept = case.parameters.iter().enumerate();
        kept.map(|(index, parameter)| (self.axis != Some(index)).then(|| parameter.clone())).collect()
    }
}
