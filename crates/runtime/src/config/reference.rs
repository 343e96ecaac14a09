//! The reference of a loop: the `[reference]` table of a scenario, with a constant, a course or a table for each field of the rig.
//!
//! Each field is an input of the loop. This file must not know what a field means.

use super::checks::Checks;
use super::error::nearest;
use super::input::{
    InputInfo, InputUser, RawInput, RawValue, ResponseField, Setting, ShapeName, Variability, change_of,
};
use crate::bus::{Port, Signal};
use crate::config::body::BodyInfo;
use crate::input::{Change, Shape, Values};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// The most rows of a table.
const ROWS_MAX: usize = 10_000;

/// The `[reference]` table as typed.
pub(crate) type RawReferences = BTreeMap<String, RawReference>;

/// The reference of one field as typed.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "unknown reference; give a number, a list of numbers, or a table with `shape`, `rows` or `file`"
)]
pub(crate) enum RawReference {
    Constant(RawValue),
    Course(RawCourse),
}

/// A reference that changes, as typed: either one change as in `[[input]]`, or a table of times and values.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct RawCourse {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rows: Vec<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub initial: Option<RawValue>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<RawValue>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shape: Option<ShapeName>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub duration_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frequency_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_frequency_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hold_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
}

/// Replaces every file of the table by its rows, so that the scenario needs no file any more. Files are refused as `checks` records.
pub(crate) fn read_files(raw: &mut RawReferences, fields: &[(&str, usize)], checks: &mut Checks<'_>) {
    for (name, reference) in raw {
        let (RawReference::Course(course), Some((_, count))) =
            (reference, fields.iter().find(|(field, _)| field == name))
        else {
            continue;
        };
        let Some(file) = &course.file else { continue };
        let key = format!("reference.{name}.file");
        if !course.rows.is_empty() {
            checks.refuse(&key, "unused-key", "has no meaning beside `rows`; remove one of them");
            continue;
        }
        let path = checks.file(&key, file);
        match read_rows(&path, name, *count) {
            Ok(rows) => (course.rows, course.file) = (rows, None),
            Err(reason) => checks.refuse(&key, "bad-table", format!("{}: {reason}", path.display())),
        }
    }
}

/// Returns the rows of a CSV file: the column `time_s`, then those of the field, `name` or `name[0]`, `name[1]`, …
fn read_rows(path: &Path, name: &str, count: usize) -> Result<Vec<Vec<f64>>, String> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_path(path);
    let reader = reader.as_mut().map_err(|error| format!("{error}; name a CSV file with a header"))?;
    let header = reader.headers().map_err(|error| error.to_string())?.clone();
    let elements = (0..count).map(|element| if count == 1 { name.to_owned() } else { format!("{name}[{element}]") });
    let columns = std::iter::once("time_s".to_owned()).chain(elements).map(|column| {
        let place = header.iter().position(|title| title == column);
        place.map(|place| (place, column.clone())).ok_or_else(|| format!("there is no column `{column}`; add it"))
    });
    let columns = columns.collect::<Result<Vec<_>, String>>()?;
    let row = |record: Result<csv::StringRecord, csv::Error>| {
        let record = record.map_err(|error| error.to_string())?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |(place, column): &(usize, String)| {
            let cell = record.get(*place).unwrap_or_default();
            cell.parse::<f64>().map_err(|_| format!("line {line}: `{cell}` in {column} is no number; correct it"))
        };
        columns.iter().map(number).collect::<Result<Vec<f64>, String>>()
    };
    reader.records().map(row).collect()
}

/// Returns the inputs that a rig's reference adds, with the values at tick 0. `fields` are those of the rig.
pub(crate) fn inputs(
    raw: &RawReferences,
    fields: &[(&'static str, usize)],
    (bodies, signals): (&[BodyInfo], &[Port]),
    checks: &mut Checks<'_>,
) -> Vec<InputInfo> {
    let names: Vec<&str> = fields.iter().map(|(name, _)| *name).collect();
    for name in raw.keys().filter(|name| !names.contains(&name.as_str())) {
        let reason = match names.is_empty() {
            true => "this rig has no reference; remove it".to_owned(),
            false => format!("the rig has no such reference; {}", nearest(name, &names)),
        };
        checks.refuse(&format!("reference.{name}"), "unknown-key", reason);
    }
    let mut first = 0;
    let input = |(name, count): &(&'static str, usize)| {
        let key = format!("reference.{name}");
        let (number, blank) = (first, vec![0.0; *count]);
        first += count;
        let info = InputInfo::new(&key, Variability::Input, format!("reference of {name}"), &blank)
            .used_by([InputUser::Reference], number)
            .seen_in(response(name, bodies, signals));
        let initial = initial(raw.get(*name), &info, &key, checks).unwrap_or_default();
        InputInfo { initial: initial[..*count].to_vec(), ..info }
    };
    fields.iter().map(input).collect()
}

/// Returns the quantity that shows the response to a step of a field: that of the first driven body.
fn response(name: &'static str, bodies: &[BodyInfo], signals: &[Port]) -> Option<ResponseField> {
    let body = bodies.iter().position(|body| body.driven)?;
    let fields = |signal| {
        let port = signals.iter().find(|port| port.topic.body == bodies[body].name && port.topic.signal == signal);
        port.map_or(&[][..], |port| &port.fields)
    };
    let commanded = fields(Signal::Command).first()?.name;
    let command = fields(Signal::Truth).iter().map(|field| field.name);
    let mut command = command.filter(|field| field.strip_prefix("applied_").unwrap_or(field) == commanded);
    Some(ResponseField { body, field: name, element: None, relative: false, command: command.next(), disturbs: false })
}

/// Returns the value of a field at tick 0: zero unless the scenario gives another.
fn initial(raw: Option<&RawReference>, info: &InputInfo, key: &str, checks: &mut Checks<'_>) -> Option<Values> {
    let (value, key) = match raw? {
        RawReference::Constant(value) => (value, key.to_owned()),
        RawReference::Course(RawCourse { initial: Some(value), .. }) => (value, format!("{key}.initial")),
        RawReference::Course(course) => {
            return course.rows.first().and_then(|row| row.get(1..)).map(InputInfo::values);
        }
    };
    let values = info.from_toml(&value.to_toml());
    values.map_err(|reason| checks.refuse(&key, "wrong-type", format!("{key} {reason}"))).ok()
}

/// Returns the changes of all fields.
pub(crate) fn changes(raw: &RawReferences, setting: &Setting<'_>, checks: &mut Checks<'_>) -> Vec<Change> {
    let mut changes = Vec::new();
    for (name, reference) in raw {
        let key = format!("reference.{name}");
        let (RawReference::Course(course), Some(number)) =
            (reference, setting.infos.iter().position(|info| info.key == key))
        else {
            continue;
        };
        if !course.rows.is_empty() {
            changes.extend(table(course, (number, &key), setting, checks));
            continue;
        }
        let RawCourse { at_s, duration_s, frequency_hz, end_frequency_hz, hold_s, seed, .. } = *course;
        let Some(value) = course.value.clone() else {
            if course.file.is_none() {
                checks.refuse(&key, "missing-key", "gives no course; add `value`, `rows` or `file`");
            }
            continue;
        };
        let shape = course.shape.unwrap_or_default();
        let at_s = at_s.unwrap_or(0.0);
        let input =
            RawInput { at_s, key: key.clone(), value, shape, duration_s, frequency_hz, end_frequency_hz, hold_s, seed };
        changes.extend(change_of(&input, key, number, setting, checks));
    }
    changes
}

/// Returns the changes by which a field follows the straight lines between the rows of a table. The values at all ticks are those of
/// the lines; before the first row and after the last one they are constant.
fn table(
    course: &RawCourse,
    (input, key): (usize, &str),
    setting: &Setting<'_>,
    checks: &mut Checks<'_>,
) -> Vec<Change> {
    let RawCourse { rows, initial: None, at_s: None, value: None, shape: None, duration_s: None, .. } = course else {
        checks.refuse(key, "unused-key", "`rows` and `file` stand alone; remove the other keys, or them");
        return Vec::new();
    };
    let width = 1 + setting.infos[input].initial.len();
    let proper = |row: &Vec<f64>| row.len() == width && row.iter().all(|number| number.is_finite()) && row[0] >= 0.0;
    if let Some(place) = rows.iter().position(|row| !proper(row)) {
        let reason = format!("row {place} has to be a time of 0 or more, s, and {} finite numbers", width - 1);
        checks.refuse(key, "bad-table", reason);
        return Vec::new();
    }
    if let Some(place) = rows.windows(2).position(|pair| pair[0][0] >= pair[1][0]) {
        checks.refuse(key, "bad-table", format!("the time of row {} is not after that of the row before", place + 1));
        return Vec::new();
    }
    checks.require(rows.len() <= ROWS_MAX, key, "too-many", || {
        format!("{} rows are more than {ROWS_MAX}; thin them out", rows.len())
    });
    let rows = &rows[..rows.len().min(ROWS_MAX)];
    // The line is straight between the ticks before and after each row.
    let near = |row: &Vec<f64>| {
        let ticks = row[0] / setting.tick_s;
        let nearest = ticks.round();
        let ends = if (ticks - nearest).abs() < 1e-6 { [nearest; 2] } else { [ticks.floor(), ticks.ceil()] };
        ends.map(|tick| tick as u64)
    };
    let mut ticks: Vec<u64> = rows.iter().flat_map(near).collect();
    ticks.sort_unstable();
    ticks.dedup();
    let change = |pair: &[u64]| {
        let shape = Shape::Row { ticks: pair[1] - pair[0] };
        Change { tick: pair[0], input, shape, values: at(rows, pair[1] as f64 * setting.tick_s) }
    };
    ticks.windows(2).map(change).collect()
}

/// Returns the values of a table at a time.
fn at(rows: &[Vec<f64>], time_s: f64) -> Values {
    let after = rows.partition_point(|row| row[0] <= time_s);
    let values = |row: &[f64]| InputInfo::values(&row[1..]);
    match (after.checked_sub(1).map(|before| &rows[before]), rows.get(after)) {
        (None, Some(row)) | (Some(row), None) => values(row),
        (Some(from), Some(to)) => {
            let part = (time_s - from[0]) / (to[0] - from[0]);
            let (from, to) = (values(from), values(to));
            std::array::from_fn(|element| from[element] + part * (to[element] - from[element]))
        }
        (None, None) => Values::default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::config::Document;
    use crate::input::Course;
    use proptest::prelude::*;

    const TICK_S: f64 = 0.01;

    /// Returns the changes of one field of a `[reference]` table, with the codes of its mistakes.
    fn resolved(table: &str, count: usize) -> (Vec<InputInfo>, Vec<Change>, Vec<&'static str>) {
        let document = Document::parse(&format!("[reference]\n{table}\n"), "test").unwrap();
        #[derive(Deserialize)]
        struct Both {
            reference: RawReferences,
        }
        let raw: Both = document.read_into().unwrap();
        let mut checks = Checks::new(&document);
        let infos = inputs(&raw.reference, &[("value_m", count)], (&[], &[]), &mut checks);
        let probe = |_: &str, _| Vec::new();
        let setting = Setting { infos: &infos, tick_s: TICK_S, last_tick: 1000, seed: 1, probe: &probe };
        let changes = changes(&raw.reference, &setting, &mut checks);
        let codes = match checks.finish(Some(())) {
            Err(super::super::ConfigError::Invalid { problems }) => {
                problems.iter().map(|problem| problem.code).collect()
            }
            _ => Vec::new(),
        };
        (infos, changes, codes)
    }

    fn value(infos: &[InputInfo], changes: &[Change], tick: u64) -> Values {
        let mut course = Course::new(InputInfo::values(&infos[0].initial));
        changes.iter().filter(|change| change.tick <= tick).for_each(|change| course.enter(change));
        course.at(tick)
    }

    #[test]
    fn constants_and_courses_give_the_value_at_every_tick() {
        let (infos, changes, codes) = resolved("value_m = 2.5", 1);
        assert_eq!((value(&infos, &changes, 0)[0], changes.len(), codes.len()), (2.5, 0, 0));
        let (infos, changes, codes) = resolved("value_m = { at_s = 0.5, value = [1.0, 2.0], initial = [3.0, 4.0] }", 2);
        assert_eq!((value(&infos, &changes, 49)[..2].to_vec(), codes.len()), (vec![3.0, 4.0], 0));
        assert_eq!(value(&infos, &changes, 50)[..2], [1.0, 2.0]);
        let (infos, changes, _) =
            resolved("value_m = { shape = \"ramp\", at_s = 1.0, duration_s = 2.0, value = 4.0 }", 1);
        assert_eq!([100, 200, 300, 900].map(|tick| value(&infos, &changes, tick)[0]), [0.0, 2.0, 4.0, 4.0]);
    }

    #[test]
    fn mistakes_are_refused_with_their_code() {
        for (table, code) in [
            ("speed_m_s = 1.0", "unknown-key"),
            ("value_m = [1.0, 2.0]", "wrong-type"),
            ("value_m = { shape = \"ramp\", value = 1.0 }", "missing-key"),
            ("value_m = { at_s = 1.0 }", "missing-key"),
            ("value_m = { value = 1.0, hold_s = 2.0 }", "unused-key"),
            ("value_m = { rows = [[0.0, 1.0], [0.0, 2.0]] }", "bad-table"),
            ("value_m = { rows = [[1.0, 1.0], [0.5, 2.0]] }", "bad-table"),
            ("value_m = { rows = [[-1.0, 1.0]] }", "bad-table"),
            ("value_m = { rows = [[0.0]] }", "bad-table"),
            ("value_m = { rows = [[0.0, 1.0]], at_s = 1.0 }", "unused-key"),
        ] {
            assert_eq!(resolved(table, 1).2, [code], "{table}");
        }
    }

    #[test]
    fn a_file_gives_the_rows_of_its_columns() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("reference.csv");
        let read = |text: &str, count| {
            std::fs::write(&path, text).unwrap();
            read_rows(&path, "value_m", count)
        };
        let scalar = read("# a comment\nvalue_m, time_s\n1.5, 0.0\n2, 0.5\n", 1).unwrap();
        assert_eq!(scalar, [vec![0.0, 1.5], vec![0.5, 2.0]]);
        let vector = read("time_s,value_m[0],other,value_m[1]\n0,1,9,2\n", 2).unwrap();
        assert_eq!(vector, [vec![0.0, 1.0, 2.0]]);
        assert!(read("time_s,value\n0,1\n", 1).unwrap_err().contains("value_m"));
        assert!(read("time_s,value_m\n0,x\n", 1).unwrap_err().contains("line 2"));
    }

    proptest! {
        /// At every tick the value is that of the straight line between the rows about it, whether they lie on ticks or not.
        #[test]
        fn a_table_is_a_line_between_its_rows(
            steps in prop::collection::vec((1e-4_f64..0.3, -5.0_f64..5.0), 1..20),
            first_s in 0.0_f64..0.2,
        ) {
            let mut time_s = first_s;
            let rows: Vec<Vec<f64>> = steps.iter().map(|(step_s, value)| {
                let row = vec![time_s, *value];
                time_s += step_s;
                row
            }).collect();
            let (infos, changes, codes) = resolved(&format!("value_m = {{ rows = {rows:?} }}"), 1);
            prop_assert!(codes.is_empty());
            for tick in 0..(time_s / TICK_S) as u64 + 5 {
                let (now, expected) = (value(&infos, &changes, tick)[0], at(&rows, tick as f64 * TICK_S)[0]);
                prop_assert!((now - expected).abs() < 1e-6, "tick {tick}: {now} is not {expected}");
            }
        }
    }
}
