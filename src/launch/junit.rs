//! A run's verdict as JUnit XML, for tools that collect test results: one suite per run, one case per criterion.
//!
//! Must not be more lenient than the exit code, and always has a case: a run that did not begin is an error.

use super::criteria::{Criterion, exact};
use super::incident::Action;
use super::summary::Summary;
use crate::config::RunId;
use crate::late::{CauseTotal, LateReport};
use crate::telemetry::PaceReport;
use quick_xml::Writer;
use std::io;

type Xml = Writer<Vec<u8>>;

/// The largest number of causes of late ticks in the properties.
const CAUSES: usize = 8;

/// The result of a case.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Verdict {
    Passed,
    /// The loop does not meet the scenario's criteria.
    Failed(String),
    /// The run itself failed.
    Error(String),
    Skipped(String),
}

struct Case {
    name: String,
    verdict: Verdict,
}

/// Writes the verdict on a run of the named scenario: its summary, or the reason for its absence.
pub fn junit(scenario: &str, run: RunId, ended: Result<&Summary, &str>) -> String {
    let mut xml = Writer::new_with_indent(Vec::new(), b' ', 2);
    write(&mut xml, scenario, run, ended).expect("memory takes every text");
    String::from_utf8_lossy(&xml.into_inner()).into_owned() + "\n"
}

fn write(xml: &mut Xml, scenario: &str, run: RunId, ended: Result<&Summary, &str>) -> io::Result<()> {
    let cases = ended.map_or_else(|reason| vec![Case::new("run", Verdict::Error(reason.to_owned()))], cases);
    let count = |matches: fn(&Verdict) -> bool| cases.iter().filter(|case| matches(&case.verdict)).count().to_string();
    let counts = [
        ("tests", cases.len().to_string()),
        ("failures", count(|verdict| matches!(verdict, Verdict::Failed(_)))),
        ("errors", count(|verdict| matches!(verdict, Verdict::Error(_)))),
        ("skipped", count(|verdict| matches!(verdict, Verdict::Skipped(_)))),
    ];
    let counts = || counts.iter().map(|(name, count)| (*name, count.as_str()));
    xml.write_event(quick_xml::events::Event::Decl(quick_xml::events::BytesDecl::new("1.0", Some("UTF-8"), None)))?;
    xml.create_element("testsuites").with_attributes(counts()).write_inner_content(|xml| {
        let name = printable(scenario);
        let mut suite = xml.create_element("testsuite").with_attribute(("name", &*name)).with_attributes(counts());
        if let Ok(summary) = ended {
            suite = suite.with_attribute(("timestamp", &*summary.started_utc));
        }
        suite.write_inner_content(|xml| {
            properties(xml, run, ended.ok())?;
            cases.iter().try_for_each(|case| case.write(xml, &name))
        })?;
        Ok(())
    })?;
    Ok(())
}

/// Returns the properties that identify the run, and the numbers of rejected samples.
fn properties(xml: &mut Xml, run: RunId, summary: Option<&Summary>) -> io::Result<()> {
    let mut properties = vec![("run".to_owned(), run.to_string())];
    if let Some(summary) = summary {
        let facts = [
            ("verdict", summary.verdict.clone()),
            ("clock", summary.clock.to_owned()),
            ("tick_hz", summary.tick_hz.to_string()),
            ("state_hash", summary.state.hash.clone()),
            ("incidents", summary.incidents.len().to_string()),
            ("rejected_samples", summary.books.rejected_samples.to_string()),
            ("version", summary.version.to_owned()),
            ("revision", summary.revision.to_owned()),
        ];
        properties.extend(facts.map(|(name, value)| (name.to_owned(), value)));
        for (signal, statuses) in &summary.score.statuses {
            let ticks = |(name, ticks): (&String, &u64)| (format!("ticks {name} of {signal}"), ticks.to_string());
            properties.extend(statuses.iter().map(ticks));
        }
        let rejected = summary.books.links.iter().filter(|link| link.rejected > 0);
        properties.extend(rejected.map(|link| {
            (format!("rejected_samples of {} at {}", link.service, link.reader), link.rejected.to_string())
        }));
        properties.extend(summary.late.iter().flat_map(late_ticks));
        properties.extend(summary.pace.iter().flat_map(|(role, pace)| paces(role, pace)));
    }
    xml.create_element("properties").write_inner_content(|xml| {
        properties.iter().try_for_each(|(name, value)| {
            let [name, value] = [name, value].map(|text| printable(text));
            let attributes = [("name", name.as_str()), ("value", &value)];
            xml.create_element("property").with_attributes(attributes).write_empty().map(drop)
        })
    })?;
    Ok(())
}

/// Returns the number of late ticks, the source of their causes, and the number for each of the largest causes.
fn late_ticks(late: &LateReport) -> Vec<(String, String)> {
    let source: &str = late.source.into();
    let totals = [("late_ticks", late.counted.to_string()), ("late_source", source.to_owned())];
    let totals = totals.map(|(name, value)| (name.to_owned(), value));
    let cause = |total: &CauseTotal| (format!("late_ticks by {}", total.cause), total.ticks.to_string());
    totals.into_iter().chain(late.causes.iter().take(CAUSES).map(cause)).collect()
}

/// Returns the relation of the run's clock to the device that sets its pace.
fn paces(role: &str, pace: &PaceReport) -> Vec<(String, String)> {
    let us = |value: Option<f64>| value.map_or("not measured".to_owned(), |us| us.to_string());
    let values = [
        ("state", pace.state.clone()),
        ("phase_error_p50_us", us(pace.phase_error_p50_us)),
        ("phase_error_p99_us", us(pace.phase_error_p99_us)),
        ("phase_error_max_us", us(pace.phase_error_max_us)),
        ("drift_ppm", pace.drift_ppm.to_string()),
        ("slips", pace.slips.to_string()),
    ];
    values.into_iter().map(|(name, value)| (format!("pace {name} of {role}"), value)).collect()
}

/// Returns the cases: the run, its counters, and the criteria in their order.
fn cases(summary: &Summary) -> Vec<Case> {
    let stopped = summary.incidents.iter().find(|incident| incident.action == Action::Stopped);
    let run = match (stopped, summary.signal) {
        (Some(incident), _) => Verdict::Error(incident.to_string()),
        (None, 0) => Verdict::Passed,
        (None, signal) => Verdict::Error(format!("ended by signal {signal} before its last tick")),
    };
    let books = match summary.books.balanced {
        true => Verdict::Passed,
        false => Verdict::Failed(format!("the counters do not balance: {}", summary.books.problems.join("; "))),
    };
    let criteria = summary.criteria.iter().map(|criterion| Case::new(&criterion.name, judge(criterion)));
    [Case::new("run", run), Case::new("books", books)].into_iter().chain(criteria).collect()
}

fn judge(criterion: &Criterion) -> Verdict {
    let limit = exact(criterion.limit);
    let role = criterion.role.as_ref().map_or(String::new(), |role| format!("{role}: "));
    match (criterion.holds, criterion.value) {
        (Some(true), _) => Verdict::Passed,
        (Some(false), Some(value)) => Verdict::Failed(format!("{role}{} is above the limit {limit}", exact(value))),
        (Some(false), None) => Verdict::Failed(format!("nothing was measured; the limit is {limit}")),
        (None, _) => {
            let reason = criterion.reason.as_ref().map_or(String::new(), |reason| format!(": {reason}"));
            Verdict::Skipped(format!("not judged{reason}"))
        }
    }
}

impl Case {
    fn new(name: &str, verdict: Verdict) -> Self {
        Self { name: name.to_owned(), verdict }
    }

    fn write(&self, xml: &mut Xml, suite: &str) -> io::Result<()> {
        let case = xml.create_element("testcase").with_attributes([("classname", suite), ("name", &self.name)]);
        let (element, message) = match &self.verdict {
            Verdict::Passed => return case.write_empty().map(drop),
            Verdict::Failed(message) => ("failure", message),
            Verdict::Error(message) => ("error", message),
            Verdict::Skipped(message) => ("skipped", message),
        };
        let message = printable(message);
        case.write_inner_content(|xml| {
            xml.create_element(element).with_attribute(("message", &*message)).write_empty().map(drop)
        })?;
        Ok(())
    }
}

/// Returns a text without the characters that XML does not allow: a role's output and the name of a task may be anything.
fn printable(text: &str) -> String {
    let held = |c: char| matches!(c, '\t' | '\n' | ' '..='\u{d7ff}' | '\u{e000}'..='\u{fffd}' | '\u{10000}'..);
    text.chars().map(|c| if held(c) { c } else { char::REPLACEMENT_CHARACTER }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::fixture;

    fn criterion(value: Option<f64>, holds: Option<bool>) -> Criterion {
        let name = "sync_error_rad_s_max".to_owned();
        Criterion { name, limit: 1e-6, value, holds, role: None, reason: None, default: false }
    }

    #[test]
    fn a_verdict_says_the_value_and_the_limit() {
        assert_eq!(judge(&criterion(Some(1e-7), Some(true))), Verdict::Passed);
        assert_eq!(
            judge(&criterion(Some(0.25), Some(false))),
            Verdict::Failed("2.5e-1 is above the limit 1e-6".into())
        );
        let infinite = judge(&criterion(Some(f64::INFINITY), Some(false)));
        assert_eq!(infinite, Verdict::Failed("inf is above the limit 1e-6".into()));
        let nothing = judge(&criterion(None, Some(false)));
        assert_eq!(nothing, Verdict::Failed("nothing was measured; the limit is 1e-6".into()));
        assert!(matches!(judge(&criterion(None, None)), Verdict::Skipped(_)));
    }

    #[test]
    fn late_ticks_are_counted_for_the_eight_largest_causes() {
        let report = fixture::report();
        let properties = late_ticks(&report);
        let value = |name: &str| properties.iter().find(|property| property.0 == name).map(|property| &*property.1);
        assert_eq!((value("late_ticks"), value("late_source")), (Some(&*report.counted.to_string()), Some("kernel")));
        assert!(report.causes.len() > CAUSES);
        assert_eq!(properties.len(), 2 + CAUSES);
        let [first, .., ninth] = &report.causes[..=CAUSES] else { panic!("{:?}", report.causes) };
        assert_eq!(value(&format!("late_ticks by {}", first.cause)), Some(&*first.ticks.to_string()));
        assert_eq!(value(&format!("late_ticks by {}", ninth.cause)), None);
    }

    /// Another parser reads the file, whatever a failing role prints.
    #[test]
    fn a_run_that_failed_is_one_error_whatever_its_reason_holds() {
        let reason = "follower died: \u{1b}[31m<oops> & \"gone\"\0\u{ffff}\nline 2 ]]> é";
        let run = RunId::from_bits([7; 16]);
        let text = junit("a<b", run, Err(reason));
        let document = roxmltree::Document::parse(&text).unwrap();
        let suite = document.root_element().first_element_child().unwrap();
        assert_eq!((suite.tag_name().name(), suite.attribute("name")), ("testsuite", Some("a<b")));
        assert_eq!((suite.attribute("tests"), suite.attribute("errors")), (Some("1"), Some("1")));
        let property = document.descendants().find(|node| node.has_tag_name("property")).unwrap();
        assert_eq!((property.attribute("name"), property.attribute("value")), (Some("run"), Some(&*run.to_string())));
        let error = document.descendants().find(|node| node.has_tag_name("error")).unwrap();
        let message = error.attribute("message").unwrap();
        assert!(message.starts_with("follower died: \u{fffd}[31m<oops> & \"gone\"\u{fffd}\u{fffd}"), "{message:?}");
        assert!(message.ends_with("]]> é"), "{message:?}");
    }
}
