//! Holds the program to its word on bad input: exit code 2, one clear message with place, key, reason and remedy; nothing
//! started, nothing left. Whatever the text, the parser answers and never panics.
//!
//! Most cases change one line of the shipped scenario rigid-pair; the line that must be named is found in the changed text.

mod common;

use common::{Bench, Done, shipped};
use corotate::config::{SHIPPED, Scenario};
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::test_runner::RngSeed;
use std::path::PathBuf;

/// The text that is spoilt.
const PAIR: &str = include_str!("../config/rigid-pair.toml");
/// The name that it is given, as messages must name it.
const FILE: &str = "bad.toml";

/// What one key is set to, and what must be said of it: a part of the reason, a part of the remedy.
type Row = (&'static str, &'static str, &'static str, &'static str);

/// The line numbers, from 1, and paths of all keys and tables of a text that is laid out as the shipped ones.
fn paths(text: &str) -> Vec<(usize, String)> {
    let mut found: Vec<(usize, String)> = Vec::new();
    let mut table = String::new();
    for (number, line) in (1..).zip(text.lines()) {
        if let Some((name, _)) = line.strip_prefix("[[").and_then(|rest| rest.split_once("]]")) {
            let of_list = |path: &&(usize, String)| path.1.starts_with(&format!("{name}[")) && path.1.ends_with(']');
            table = format!("{name}[{}]", found.iter().filter(of_list).count());
            found.push((number, table.clone()));
        } else if let Some((name, _)) = line.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            table = name.to_owned();
            found.push((number, table.clone()));
        } else if let Some((key, _)) = line.split_once(" = ").filter(|_| !line.starts_with('#')) {
            found.push((number, if table.is_empty() { key.to_owned() } else { format!("{table}.{key}") }));
        }
    }
    found
}

/// The keys of the spoilt text, without its tables.
fn keys() -> Vec<String> {
    let is_key = |number: usize| !line(number).starts_with('[');
    paths(PAIR).into_iter().filter(|(number, _)| is_key(*number)).map(|(_, path)| path).collect()
}

/// A line of the spoilt text.
fn line(number: usize) -> &'static str {
    PAIR.lines().nth(number - 1).unwrap()
}

fn line_of(text: &str, key: &str) -> Option<usize> {
    paths(text).into_iter().find(|(_, path)| path == key).map(|(number, _)| number)
}

/// The table that a key belongs to, and its name there.
fn split(key: &str) -> (Option<&str>, &str) {
    key.rsplit_once('.').map_or((None, key), |(table, name)| (Some(table), name))
}

/// The text with another line in the place of one, or more lines, or none.
fn replace(text: &str, number: usize, by: &[&str]) -> String {
    let mut lines: Vec<&str> = text.lines().collect();
    lines.splice(number - 1..number, by.iter().copied());
    lines.join("\n") + "\n"
}

/// The text with one key set to a value, in its place or as the first of its table.
fn with(text: &str, key: &str, value: &str) -> String {
    let (table, name) = split(key);
    let line = format!("{name} = {value}");
    match (line_of(text, key), table) {
        (Some(number), _) => replace(text, number, &[&line]),
        (None, Some(table)) => {
            let head = line_of(text, table).unwrap();
            replace(text, head, &[text.lines().nth(head - 1).unwrap(), &line])
        }
        (None, None) => format!("{line}\n{text}"),
    }
}

/// The text without a table and its keys, every other line where it was.
fn without_table(table: &str) -> String {
    let of_table = |path: &str| path == table || path.starts_with(&format!("{table}."));
    let gone: Vec<usize> =
        paths(PAIR).into_iter().filter(|(_, path)| of_table(path)).map(|(number, _)| number).collect();
    let keep = |(number, line)| if gone.contains(&number) { "" } else { line };
    (1..).zip(PAIR.lines()).map(keep).collect::<Vec<_>>().join("\n")
}

/// Where a message must say that a key is: its line, its table's line, or the file.
fn place(text: &str, key: &str) -> String {
    let around = std::iter::successors(Some(key), |key| key.rfind(['.', '[']).map(|end| &key[..end]));
    match around.into_iter().find_map(|key| line_of(text, key)) {
        Some(number) => format!("{FILE}:{number}"),
        None => FILE.to_owned(),
    }
}

/// Everything that a bench's directory and runtime directory hold.
fn contents(bench: &Bench) -> Vec<PathBuf> {
    let command = bench.command();
    let runtime = command.get_envs().find(|(name, _)| *name == "XDG_RUNTIME_DIR").and_then(|(_, value)| value).unwrap();
    let directories = [bench.path(""), PathBuf::from(runtime)];
    directories.iter().flat_map(|path| std::fs::read_dir(path).unwrap()).map(|entry| entry.unwrap().path()).collect()
}

/// Runs what must be refused before anything is started, and returns what it says.
fn refused_in(bench: &Bench, arguments: &[&str]) -> Done {
    let before = contents(bench);
    let done = bench.run(arguments);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert!(!done.stderr.is_empty() && !done.stderr.contains("panicked"), "{done:?}");
    // A message that fills the screen, or paints on it, is not clear.
    assert!(done.stderr.lines().all(|line| line.len() < 2000 && !line.contains(char::is_control)), "{done:?}");
    assert_eq!(contents(bench), before, "something was left");
    assert!(bench.processes().is_empty(), "something was started and still runs");
    done
}

/// Runs a text that must be refused, and returns the lines that say why.
fn refused(text: impl AsRef<[u8]>, arguments: &[&str]) -> Vec<String> {
    let bench = Bench::new();
    std::fs::write(bench.path(FILE), text).unwrap();
    let done = refused_in(&bench, &[&["run", FILE], arguments].concat());
    assert_eq!(done.stdout, "", "{done:?}");
    let lines: Vec<String> = done.stderr.lines().map(str::to_owned).collect();
    assert!(lines.iter().all(|line| line.starts_with("corotate: ")), "{lines:?}");
    assert!(lines.len() <= 3, "one fault, {} findings: {lines:?}", lines.len());
    lines
}

/// Asserts that one of the lines says all of this.
fn assert_says(lines: &[String], start: &str, parts: &[&str]) {
    let says = |line: &String| line.starts_with(start) && parts.iter().all(|part| line.contains(part));
    assert!(lines.iter().any(says), "expected {start:?} and {parts:?}, got {lines:#?}");
}

/// Asserts that a text is refused for one key, in the right place.
fn assert_refused(text: &str, key: &str, parts: &[&str]) {
    assert_says(&refused(text, &[]), &format!("corotate: {}: {key}", place(text, key)), parts);
}

fn assert_all_refused(rows: &[Row]) {
    for (key, value, reason, remedy) in rows {
        assert_refused(&with(PAIR, key, value), key, &[reason, remedy]);
    }
}

#[test]
fn a_name_a_rig_and_a_clock_are_what_they_can_be() {
    let long = format!("\"{}\"", "a".repeat(200));
    assert_refused(&with(PAIR, "name", &long), "name", &["cannot name", "use 1 to 32"]);
    assert_refused(&with(PAIR, "follower[0].name", &long), "follower[0].name", &["cannot name", "use 1 to 32"]);
    assert_all_refused(&[
        ("name", "\"\"", "cannot name", "use 1 to 32"),
        ("name", "\"a/b\"", "cannot name", "use 1 to 32"),
        ("name", "\"../up\"", "cannot name", "use 1 to 32"),
        ("name", "\"Pair\"", "cannot name", "use 1 to 32"),
        ("name", "\"a b\"", "cannot name", "use 1 to 32"),
        ("name", r#""a\nb""#, "cannot name", "use 1 to 32"),
        ("name", r#""\u001b[31m""#, "cannot name", "use 1 to 32"),
        ("name", r#""a\u0000b""#, "cannot name", "use 1 to 32"),
        ("rig", "\"rigid-bodi\"", "there is no rig", "did you mean `rigid-body`?"),
        ("rig", "\"pendulum\"", "there is no rig", "known here: rigid-body"),
        ("rig", "\"\"", "there is no rig", "known here: rigid-body"),
        ("clock", "\"fast\"", "no choice `fast`", "known here: realtime, lockstep, in-process"),
        ("clock", "\"lokstep\"", "no choice `lokstep`", "did you mean `lockstep`?"),
        ("clock", "1", "got", "give a text in quotes"),
    ]);
}

#[test]
fn a_tick_and_a_length_are_within_what_can_be_run() {
    assert_all_refused(&[
        ("tick_hz", "0", "outside", "give a rate"),
        ("tick_hz", "0.0", "outside", "give a rate"),
        ("tick_hz", "-0.0", "outside", "give a rate"),
        ("tick_hz", "-1000.0", "outside", "give a rate"),
        ("tick_hz", "0.09", "outside", "give a rate from 0.1 to 100000 Hz"),
        ("tick_hz", "100001", "outside", "give a rate from 0.1 to 100000 Hz"),
        ("tick_hz", "1e9", "outside", "give a rate"),
        ("duration_s", "0", "0 ticks", "give a length"),
        ("duration_s", "-1", "-1000 ticks", "give a length"),
        ("duration_s", "1e-9", "ticks", "give a length"),
        ("duration_s", "1e11", "ticks", "give a length"),
    ]);
}

#[test]
fn nothing_else_is_said_of_a_tick_that_cannot_be() {
    for tick_hz in ["0", "-5", "0.01", "1e-9", "1e7"] {
        assert_eq!(refused(with(PAIR, "tick_hz", tick_hz), &[]).len(), 1, "{tick_hz}");
        for (name, text) in SHIPPED {
            let message = Scenario::parse(&with(text, "tick_hz", tick_hz), FILE, &[]).unwrap_err().to_string();
            assert_eq!(message.lines().count(), 1, "{name} at {tick_hz} Hz: {message}");
        }
    }
}

#[test]
fn a_leader_is_a_body_with_one_hidden_axis() {
    assert_all_refused(&[
        ("leader.inertia_kg_m2", "[0.0, 2.0, 2.5]", "I1 = 0 is not", "above zero"),
        ("leader.inertia_kg_m2", "[1.0, -2.0, 2.5]", "I2 = -2 is not", "above zero"),
        ("leader.inertia_kg_m2", "[1.0, 2.0, 3.5]", "triangle inequality", "lower I3"),
        ("leader.inertia_kg_m2", "[2.0, 2.0, 2.0]", "sphere", "give moments of inertia that differ"),
        ("leader.inertia_kg_m2", "[1.0, 2.0]", "got 2", "give a list of 3 numbers"),
        ("leader.inertia_kg_m2", "[1.0, 2.0, 2.5, 1.0]", "got 4", "give fewer"),
        ("leader.inertia_kg_m2", "[]", "got 0", "give a list of 3 numbers"),
        ("leader.inertia_kg_m2", "1.0", "got", "give a list of 3 numbers"),
        ("leader.inertia_kg_m2", "[1.0, \"2.0\", 2.5]", "got string", "give a number"),
        ("leader.initial_rate_rad_s", "[0.6, -0.4]", "got 2", "give a list of 3 numbers"),
        ("leader.measured_axes", "[]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[2]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[1, 1]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[0, 1]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[1, 4]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[1, 2, 3]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[1, 2, 2]", "exactly one axis hidden", "name two different axes"),
        ("leader.measured_axes", "[1, -2]", "got integer `-2`", "give a whole number, not below 0"),
        ("leader.measured_axes", "[1.0, 2.0]", "got", "give a whole number"),
        ("leader.measured_axes", "\"1, 2\"", "got string", "give a list"),
    ]);
}

#[test]
fn no_shipped_scenario_takes_an_axis_that_no_body_has() {
    for (name, text) in SHIPPED {
        for key in ["leader.measured_axes", "leader.outage[0].axis", "observer.symmetry_axis"] {
            let values: &[&str] = if key.ends_with("axes") {
                &["[0]", "[0, 1]", "[0, 1, 2]", "[1, 2, 4]", "[1, 1, 1]", "[1, 2, 999]", "[1, 2, 3, 4]"]
            } else {
                &["0", "4", "999"]
            };
            for value in values.iter().filter(|_| line_of(text, key).is_some()) {
                let message = Scenario::parse(&with(text, key, value), FILE, &[]).unwrap_err().to_string();
                assert!(message.contains(&format!("{}: {key}: ", place(text, key))), "{name}, {value}: {message}");
            }
        }
    }
}

#[test]
fn nothing_is_said_of_a_rig_s_criteria_where_there_is_no_rig() {
    for (key, value) in [("leader.inertia_kg_m2", "[0.0, 2.0, 2.5]"), ("leader.measured_axes", "[]"), ("rig", "\"x\"")]
    {
        assert_eq!(refused(with(PAIR, key, value), &[]).len(), 1, "{key}");
    }
}

#[test]
fn followers_have_names_of_their_own() {
    assert_all_refused(&[
        ("follower[0].name", "\"\"", "cannot name a process", "use 1 to 32"),
        ("follower[0].name", "\"Leader One\"", "cannot name a process", "use 1 to 32"),
        ("follower[0].name", "\"a/b\"", "cannot name a process", "use 1 to 32"),
        ("follower[0].name", "\"leader\"", "taken", "choose another"),
        ("follower[0].name", "\"observer\"", "taken", "choose another"),
        ("follower[0].name", "\"controller\"", "taken", "choose another"),
        ("follower[0].initial_rate_rad_s", "[0.1]", "got 1", "give a list of 3 numbers"),
    ]);
    let twins = format!("{PAIR}\n[[follower]]\nname = \"follower\"\ninitial_rate_rad_s = [0.0, 0.0, 0.0]\n");
    assert_refused(&twins, "follower[1].name", &["`follower` is taken", "choose another"]);
}

#[test]
fn there_are_as_many_followers_as_a_run_can_hold() {
    let none = without_table("follower[0]");
    for text in [format!("follower = []\n{none}"), none] {
        assert_says(&refused(text, &[]), &format!("corotate: {FILE}"), &["follower", "add"]);
    }
    let more: String = (0..2000)
        .map(|index| format!("[[follower]]\nname = \"f{index}\"\ninitial_rate_rad_s = [0.0, 0.0, 0.0]\n"))
        .collect();
    assert_says(&refused(format!("{PAIR}\n{more}"), &[]), "corotate: ", &["follower: 2001 are more", "give at most"]);
}

#[test]
fn an_observer_and_a_controller_can_do_their_work() {
    assert_all_refused(&[
        ("observer.decay_rate_per_s", "0", "not above zero", "give a positive number"),
        ("observer.decay_rate_per_s", "-6.0", "not above zero", "give a positive number"),
        ("observer.initial_guess_rad_s", "1e9", "ambiguous", "guess nearer to 0"),
        ("observer.initial_guess_rad_s", "-1e9", "ambiguous", "guess nearer to 0"),
        ("observer.observability_floor_rad_s", "0.0", "not above zero", "give a positive number"),
        ("observer.observability_floor_rad_s", "-1e-6", "not above zero", "give a positive number"),
        ("observer.observability_floor_rad_s", "100.0", "never observed", "lower it"),
        ("controller.gain_per_s", "[0.0, 4.0, 4.0]", "not above zero", "give a positive number"),
        ("controller.gain_per_s", "[4.0, 4.0, -4.0]", "not above zero", "give a positive number"),
        ("controller.gain_per_s", "[4.0, 1000.0, 4.0]", "unstable", "lower the gain or raise tick_hz"),
        ("controller.gain_per_s", "[4.0, 1e9, 4.0]", "unstable", "lower the gain or raise tick_hz"),
        ("controller.gain_per_s", "[4.0, 4.0]", "got 2", "give a list of 3 numbers"),
        ("controller.gain_per_s", "4.0", "got", "give a list of 3 numbers"),
        ("controller.predict", "1", "got integer `1`", "give true or false"),
    ]);
}

#[test]
fn nothing_turns_too_far_in_one_tick() {
    let fast = with(PAIR, "leader.initial_rate_rad_s", "[60.0, -40.0, 80.0]");
    assert_refused(&with(&fast, "tick_hz", "0.2"), "tick_hz", &["ambiguous", "raise tick_hz above"]);
    let fast = with(PAIR, "follower[0].initial_rate_rad_s", "[1e9, 0.0, 0.0]");
    assert_refused(&fast, "follower[0].initial_rate_rad_s", &["turns too far", "lower it or raise tick_hz"]);
    // On a hyperbola no phase comes round, but nothing follows such a motion either.
    let hyperbolic = std::fs::read_to_string(shipped("rigid-pair-hyperbolic")).unwrap();
    let fast = with(&hyperbolic, "leader.initial_rate_rad_s", "[1e5, 1e5, 1e5]");
    assert_refused(&fast, "tick_hz", &["ambiguous", "raise tick_hz above"]);
    let wild = with(&hyperbolic, "observer.initial_guess_rad_s", "1e9");
    assert_refused(&wild, "observer.initial_guess_rad_s", &["ambiguous", "guess nearer to 0"]);
}

#[test]
fn actuators_real_time_and_launch_have_limits() {
    assert_all_refused(&[
        ("actuator.command_timeout_ticks", "0", "every tick unsafe", "give at least 1"),
        ("actuator.command_timeout_ticks", "-1", "got integer `-1`", "give a whole number, not below 0"),
        ("actuator.command_timeout_ticks", "1.5", "got", "give a whole number"),
        ("actuator.rearm", "\"never\"", "no choice `never`", "known here: auto, manual"),
        ("realtime.priority", "100", "no SCHED_FIFO priority", "give 1 to 99"),
        ("realtime.priority", "-3", "no SCHED_FIFO priority", "give 1 to 99"),
        ("realtime.priority", "80.0", "got", "give a whole number"),
        ("realtime.priority", "99999999999", "got integer", "give a whole number"),
        ("realtime.cores", "[]", "empty", "name cores of this machine"),
        ("realtime.cores", "[5000]", "beyond 1023", "name cores of this machine"),
        ("realtime.cores", "\"fastest\"", "no such choice", "give \"auto\", \"any\", or a list"),
        ("realtime.cores", "[-1]", "no such choice", "give \"auto\", \"any\", or a list"),
        ("realtime.cores", "[0.5]", "no such choice", "give \"auto\", \"any\", or a list"),
        ("realtime.cores", "3", "no such choice", "give \"auto\", \"any\", or a list"),
        ("realtime.lock_memory", "\"yes\"", "got string", "give true or false"),
        ("realtime.wake_lead_us", "-1", "no time to spin", "give 0 to 100000"),
        ("realtime.wake_lead_us", "1e9", "no time to spin", "give 0 to 100000"),
        ("realtime.spin_us", "-1", "no time to spin", "give 0 to 100000"),
        ("realtime.spin_us", "1e9", "no time to spin", "give 0 to 100000"),
        ("realtime.cutoff", "0", "no part of the period", "give a number above 0"),
        ("realtime.cutoff", "2", "no part of the period", "give a number above 0"),
        ("realtime.cutoff", "-0.5", "no part of the period", "give a number above 0"),
        ("launch.startup_timeout_s", "0", "no time to wait", "give 0.1 to 3600"),
        ("launch.startup_timeout_s", "-1", "no time to wait", "give 0.1 to 3600"),
        ("launch.startup_timeout_s", "1e9", "no time to wait", "give 0.1 to 3600"),
        ("launch.external_timeout_s", "0", "no time to wait", "give 0.1 to 604800"),
        ("launch.external_timeout_s", "-1", "no time to wait", "leave it out"),
        ("launch.external_timeout_s", "1e9", "no time to wait", "give 0.1 to 604800"),
        ("launch.external_timeout_s", "\"long\"", "got string", "give a number"),
        ("launch.external", "\"follower\"", "got string", "give a list"),
        ("launch.external", "[1]", "got integer", "give a text in quotes"),
        ("launch.external", "[\"nosuch\"]", "no role `nosuch`", "has: leader, follower, observer, controller"),
        ("launch.external", "[\"follower\", \"\"]", "no role ``", "has: leader, follower, observer, controller"),
    ]);
    let alone = with(&with(PAIR, "launch.external", "[\"follower\"]"), "clock", "\"in-process\"");
    assert_refused(&alone, "launch.external", &["one process", "or leave it empty"]);
}

#[test]
fn criteria_are_known_and_can_be_met() {
    assert_all_refused(&[
        ("accept.settled_by_s", "-1", "below zero", "give 0 or more"),
        ("accept.settled_by_s", "10.0", "nothing would be judged", "lower it or raise duration_s"),
        ("accept.settled_by_s", "20", "nothing would be judged", "lower it or raise duration_s"),
        ("accept.settled_by_s", "\"8 s\"", "got string", "give a number"),
        ("accept.sync_error_rad_s_max", "-1e-6", "below zero", "give 0 or more"),
        ("accept.missed_ticks_max", "0.5", "no count of ticks", "give a whole number"),
        ("accept.missed_ticks_max", "-1", "below zero", "give 0 or more"),
        ("accept.missed_ticks_max", "1e300", "no quantity", "give"),
        ("accept.missed_ticks_max", "\"0\"", "got string", "give a number"),
        ("accept.step_latency_p99_us_max", "-3", "below zero", "give 0 or more"),
        ("accept.sync_eror_rad_s_max", "1", "unknown criterion", "did you mean `sync_error_rad_s_max`?"),
        ("accept.sync_error_rad_s", "1", "unknown criterion", "did you mean `sync_error_rad_s_max`?"),
        ("accept.foo", "1", "unknown criterion", "known here: sync_error_rad_s_max"),
        ("accept._max", "1", "unknown criterion", "known here: sync_error_rad_s_max"),
    ]);
    assert_refused(&with(PAIR, "duration_s", "5"), "accept.settled_by_s", &["nothing would be judged", "lower it"]);
}

/// The values of a key with each of their numbers, if it has any, replaced.
fn with_number(key: &str, number: &str) -> Vec<String> {
    let line = line(line_of(PAIR, key).unwrap());
    let value = line.split_once(" = ").unwrap().1.split('#').next().unwrap().trim();
    match value.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
        Some(list) => {
            let items: Vec<&str> = list.split(',').map(str::trim).collect();
            let replaced = |at: usize| {
                let items: Vec<&str> =
                    (0..items.len()).map(|index| if index == at { number } else { items[index] }).collect();
                format!("[{}]", items.join(", "))
            };
            (0..items.len()).map(replaced).collect()
        }
        None if value.parse::<f64>().is_ok() => vec![number.to_owned()],
        None => Vec::new(),
    }
}

#[test]
fn no_number_anywhere_is_infinite_undefined_or_absurd() {
    for key in keys() {
        for (number, reason) in [("nan", "not a finite"), ("inf", "not a finite"), ("-inf", "not a finite")] {
            for value in with_number(&key, number) {
                assert_refused(&with(PAIR, &key, &value), &key, &[reason, "give"]);
            }
        }
        for number in ["1e308", "-1e308", "1e-320"] {
            for value in with_number(&key, number).into_iter().take(1) {
                assert_refused(&with(PAIR, &key, &value), &key, &["no quantity", "give"]);
            }
        }
    }
    for key in ["accept.missed_ticks_max", "accept.step_latency_p99_us_max", "accept.foo"] {
        for number in ["nan", "inf", "-inf"] {
            assert_refused(&with(PAIR, key, number), key, &["not a finite", "give"]);
        }
    }
}

#[test]
fn a_number_that_no_machine_holds_is_refused_at_its_line() {
    for (key, number, reason) in [
        ("tick_hz", "1e400", "overflowed"),
        ("tick_hz", "-1e999999999999", "overflowed"),
        ("duration_s", "99999999999999999999", "give a smaller number"),
        ("actuator.command_timeout_ticks", "9223372036854775808", "too large"),
        ("realtime.priority", "-99999999999999999999", "give a smaller number"),
    ] {
        let text = with(PAIR, key, number);
        assert_says(&refused(&text, &[]), &format!("corotate: {}:", place(&text, key)), &[reason, "correct the line"]);
    }
}

#[test]
fn every_key_refuses_every_other_type() {
    let kinds = [("\"", "\"a word\""), ("number", "7.25"), ("true false", "true"), ("[", "[[]]"), ("{", "{ a = 1 }")];
    for key in keys() {
        let line = line(line_of(PAIR, &key).unwrap());
        let value = line.split_once(" = ").unwrap().1;
        let word = value.split_whitespace().next().unwrap();
        for (kind, wrong) in kinds {
            let right =
                value.starts_with(kind) || kind.contains(word) || kind == "number" && word.parse::<f64>().is_ok();
            if !right {
                let text = with(PAIR, &key, wrong);
                let lines = refused(&text, &[]);
                assert_says(&lines, &format!("corotate: {}: {key}", place(&text, &key)), &[]);
                assert!(lines[0].contains("give") || lines[0].contains("known here"), "no remedy: {lines:?}");
                let jargon = ["f64", "u64", "i32", "usize", "struct", "sequence", "map", "variant", "invalid type"];
                assert!(!jargon.iter().any(|word| lines[0].contains(word)), "for Rust programmers only: {lines:?}");
            }
        }
    }
}

#[test]
fn a_misspelt_key_is_refused_with_the_right_one_in_every_table() {
    for key in keys() {
        let (table, name) = split(&key);
        let slip = format!("{}{}", &name[..2], &name[1..]);
        let number = line_of(PAIR, &key).unwrap();
        let line = line(number).replacen(name, &slip, 1);
        let misspelt = table.map_or(slip.clone(), |table| format!("{table}.{slip}"));
        let unknown = if table == Some("accept") { "unknown criterion" } else { "unknown key" };
        let remedy = format!("did you mean `{name}`?");
        assert_refused(&replace(PAIR, number, &[&line]), &misspelt, &[unknown, &remedy]);
    }
    for (table, slip) in [
        ("leader", "leeder"),
        ("follower", "folower"),
        ("observer", "obsrever"),
        ("controller", "controler"),
        ("actuator", "actuators"),
        ("realtime", "real_time"),
        ("launch", "lanch"),
        ("accept", "acept"),
    ] {
        let text = PAIR.replace(&format!("[{table}]"), &format!("[{slip}]"));
        assert_says(
            &refused(&text, &[]),
            &format!("corotate: {FILE}:"),
            &[&format!("{slip}: unknown key"), &format!("did you mean `{table}`?")],
        );
    }
}

#[test]
fn a_key_that_is_like_none_is_refused_with_all_there_are() {
    for key in
        ["zzz", "leader.zzz", "follower[0].zzz", "observer.zzz", "controller.zzz", "actuator.zzz", "realtime.zzz"]
    {
        let text = with(PAIR, key, "1");
        assert_refused(&text, key, &["unknown key", "known here: "]);
    }
    assert_refused(&with(PAIR, "zzz", "1"), "zzz", &["leader", "follower", "observer", "controller"]);
    for name in [r#""a`b""#, r#""a b""#, r#""a\nb""#, r#""\u001b[31m""#] {
        let lines = refused(format!("{name} = 1\n{PAIR}"), &[]);
        assert_says(&lines, &format!("corotate: {FILE}:1: "), &["unknown key", "known here: name, rig"]);
    }
}

#[test]
fn a_key_or_table_that_is_missing_is_asked_for() {
    let needed = [
        "name",
        "rig",
        "tick_hz",
        "duration_s",
        "leader.inertia_kg_m2",
        "leader.initial_rate_rad_s",
        "leader.measured_axes",
        "follower[0].name",
        "follower[0].initial_rate_rad_s",
        "observer.decay_rate_per_s",
        "controller.gain_per_s",
    ];
    for key in needed {
        let text = replace(PAIR, line_of(PAIR, key).unwrap(), &[]);
        assert_refused(&text, key, &["is missing", "add it"]);
    }
    for table in ["leader", "observer", "controller"] {
        assert_refused(&without_table(table), table, &["is missing"]);
    }
    for empty in ["", "\n\n", "# nothing but a comment\n"] {
        assert_refused(empty, "name", &["is missing", "add it"]);
    }
}

#[test]
fn a_key_or_table_that_appears_twice_is_refused() {
    for key in keys() {
        let number = line_of(PAIR, &key).unwrap();
        let line = line(number);
        let duplicate = format!("duplicate key `{}`", split(&key).1);
        let lines = refused(replace(PAIR, number, &[line, line]), &[]);
        assert_says(&lines, &format!("corotate: {FILE}:{}:1: ", number + 1), &[&duplicate, "correct the line"]);
    }
    for table in ["leader", "observer", "controller", "actuator", "realtime", "launch", "accept"] {
        let lines = refused(format!("{PAIR}[{table}]\n"), &[]);
        let start = format!("corotate: {FILE}:{}:2: ", PAIR.lines().count() + 1);
        assert_says(&lines, &start, &[&format!("duplicate key `{table}`"), "correct the line"]);
    }
}

#[test]
fn a_table_is_a_table_and_a_list_is_a_list() {
    for table in ["leader", "observer", "controller", "actuator", "realtime", "launch", "accept"] {
        let listed = PAIR.replace(&format!("\n[{table}]"), &format!("\n[[{table}]]"));
        let start = format!("corotate: {FILE}:{}: {table}: ", line_of(PAIR, table).unwrap());
        assert_says(&refused(&listed, &[]), &start, &["is a list", &format!("write [{table}]")]);
        let plain = format!("{table} = 3\n{}", without_table(table));
        assert_refused(&plain, table, &["got integer", "give a table"]);
    }
    // Values without their keys, in the order of the program's own structures.
    let bare = format!("leader = [[1.0, 2.0, 2.5], [0.6, -0.4, 0.8], [1, 2]]\n{}", without_table("leader"));
    assert_refused(&bare, "leader", &["is a list", "write [leader]"]);
    let single = PAIR.replace("[[follower]]", "[follower]");
    assert_refused(&single, "follower", &["got a table", "double brackets"]);
    let word = format!("follower = \"one\"\n{}", without_table("follower[0]"));
    assert_refused(&word, "follower", &["got string", "give a list"]);
    assert_refused(&with(PAIR, "accept.deeper", "{ x = 1 }"), "accept.deeper", &["got a table", "give a number"]);
}

#[test]
fn the_line_is_right_however_the_text_is_laid_out() {
    let at = line_of(PAIR, "leader.inertia_kg_m2").unwrap();
    let spread = replace(PAIR, at, &["inertia_kg_m2 = [", "  1.0,", "  nan,", "  2.5,", "]"]);
    assert_says(
        &refused(&spread, &[]),
        &format!("corotate: {FILE}:{}: leader.inertia_kg_m2[1]: ", at + 2),
        &["finite"],
    );
    let below = with(&replace(PAIR, at, &["inertia_kg_m2 = [1.0,", "  2.0, 2.5]"]), "launch.startup_timeout_s", "0");
    assert_refused(&below, "launch.startup_timeout_s", &["no time to wait"]);
    let tick = with(PAIR, "tick_hz", "0");
    for text in [tick.replace('\n', "\r\n"), format!("\u{feff}{tick}"), format!("{}{tick}", "\n".repeat(5000))] {
        let number = 1 + text.lines().position(|line| line.starts_with("tick_hz")).unwrap();
        assert_says(&refused(&text, &[]), &format!("corotate: {FILE}:{number}: tick_hz: "), &["outside"]);
    }
}

#[test]
fn what_is_no_toml_is_refused_at_its_line() {
    for (key, line) in [
        ("clock", "clock = \"realtime"),
        ("clock", "clock ="),
        ("clock", "clock"),
        ("clock", "clock = realtime"),
        ("clock", "= 3"),
        ("tick_hz", "tick_hz = --5"),
        ("tick_hz", "tick_hz = 0x"),
        ("tick_hz", "tick_hz = 1 000"),
        ("leader", "[leader"),
        ("leader", "[]"),
        ("leader", "[leader] x"),
    ] {
        let number = line_of(PAIR, key).unwrap();
        let lines = refused(replace(PAIR, number, &[line]), &[]);
        assert_says(&lines, &format!("corotate: {FILE}:{number}:"), &["; correct the line"]);
    }
}

#[test]
fn what_is_no_text_is_refused_at_its_line() {
    let bytes: Vec<u8> = (0..=255).cycle().take(4096).collect();
    assert_says(&refused(bytes, &[]), &format!("corotate: {FILE}:2:"), &["not UTF-8", "correct the line"]);
    assert_says(&refused(b"name = \"\xff\"\n", &[]), &format!("corotate: {FILE}:1:9: "), &["not UTF-8"]);
    let wide: Vec<u8> = PAIR.encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert_says(&refused(wide, &[]), &format!("corotate: {FILE}:"), &["correct the line"]);
    let program = std::fs::read(env!("CARGO_BIN_EXE_corotate")).unwrap();
    let program = &program[..100_000];
    let text = &program[..std::str::from_utf8(program).unwrap_err().valid_up_to()];
    let line = 1 + text.iter().filter(|byte| **byte == b'\n').count();
    assert_says(&refused(program, &[]), &format!("corotate: {FILE}:{line}:"), &["not UTF-8", "correct the line"]);
    assert_says(&refused(format!("{PAIR}\0"), &[]), &format!("corotate: {FILE}:"), &["correct the line"]);
}

#[test]
fn a_text_may_nest_as_deep_as_it_likes() {
    let deep = |open: &str, close: &str| format!("x = {}{}\n", open.repeat(50_000), close.repeat(50_000));
    let dotted = vec!["a"; 50_000].join(".");
    for text in [
        deep("[", ""),
        deep("[", "]"),
        deep("{a=", ""),
        deep("{a=", "}"),
        format!("{dotted} = 1\n"),
        format!("[{dotted}]\n"),
        format!("[[{dotted}]]\n"),
    ] {
        assert_says(&refused(text + PAIR, &[]), &format!("corotate: {FILE}"), &["recurs", "correct the line"]);
    }
    let just_so = format!("x = {}{}\n{PAIR}", "[".repeat(60), "]".repeat(60));
    assert_refused(&just_so, "x", &["unknown key", "known here"]);
}

#[test]
fn a_line_may_be_as_long_as_it_likes() {
    let long = "x".repeat(900_000);
    let comment = format!("# {long}\n{}", with(PAIR, "tick_hz", "0"));
    assert_refused(&comment, "tick_hz", &["outside", "give a rate"]);
    assert_refused(&with(PAIR, "name", &format!("\"{long}\"")), "name", &["xxx … xxx", "cannot name", "use 1 to 32"]);
    assert_says(&refused(format!("{long} = 1\n{PAIR}"), &[]), &format!("corotate: {FILE}:1: x"), &["unknown key"]);
    let axes = format!("[{}]", "1,".repeat(400_000));
    assert_refused(&with(PAIR, "leader.measured_axes", &axes), "leader.measured_axes", &["hidden", "name two"]);
    let moments = format!("[{}]", "1.0,".repeat(200_000));
    assert_refused(
        &with(PAIR, "leader.inertia_kg_m2", &moments),
        "leader.inertia_kg_m2",
        &["got 200000", "give fewer"],
    );
    assert_says(&refused(with(PAIR, "tick_hz", &"9".repeat(900_000)), &[]), "corotate: ", &["correct the line"]);
    assert_says(
        &refused("#".repeat(2_000_000), &[]),
        &format!("corotate: {FILE}: "),
        &["longer than", "give the path"],
    );
}

#[test]
fn what_is_no_file_is_refused() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("directory")).unwrap();
    std::fs::write(bench.path("file"), PAIR).unwrap();
    for command in ["run", "check"] {
        for (path, reason) in [
            ("nowhere.toml", "No such file"),
            ("directory", "Is a directory"),
            ("directory/nowhere.toml", "No such file"),
            ("file/below.toml", "Not a directory"),
            ("/dev/zero", "longer than"),
            ("/dev/null", "name: is missing"),
        ] {
            let done = refused_in(&bench, &[command, path]);
            assert!(
                done.stderr.starts_with(&format!("corotate: {path}: ")) && done.stderr.contains(reason),
                "{done:?}"
            );
            assert!(done.stderr.contains("give the path of a scenario file") || path == "/dev/null", "{done:?}");
            assert!(done.stdout.is_empty() && done.stderr.lines().count() == 1, "{done:?}");
        }
    }
}

#[test]
fn an_override_that_cannot_be_read_is_refused() {
    let deep = format!("{}=1", vec!["a"; 60_000].join("."));
    let nested = format!("tick_hz={}", "[".repeat(100_000));
    for (argument, reason) in [
        ("tick_hz", "no `=`"),
        ("", "no `=`"),
        ("=", "neither TOML nor a bare word"),
        ("=1", "key is empty"),
        (".=1", "key is empty"),
        ("tick_hz.=1", "key is empty"),
        ("leader..x=1", "key is empty"),
        ("follower.7.name=x", "no 7"),
        ("follower.1.name=x", "no 1"),
        ("follower[1].name=x", "no 1"),
        ("follower.one.name=x", "not a position"),
        ("follower.-1.name=x", "not a position"),
        ("follower.99999999999999999999.name=x", "not a position"),
        ("name.x=1", "plain value"),
        ("leader.inertia_kg_m2.0.x=1", "plain value"),
        ("tick_hz=", "neither TOML nor a bare word"),
        ("tick_hz=[1,", "neither TOML nor a bare word"),
        ("tick_hz='x", "neither TOML nor a bare word"),
        ("tick_hz=a b", "neither TOML nor a bare word"),
        ("tick_hz==5", "neither TOML nor a bare word"),
        ("tick_hz=1\nname=\"x\"", "neither TOML nor a bare word"),
        ("name=\u{1b}[31m", "neither TOML nor a bare word"),
        (&deep, "no key lies so deep"),
        (&nested, "neither TOML nor a bare word"),
    ] {
        let shown: String = argument.chars().take_while(|c| !c.is_control()).take(100).collect();
        let lines = refused(PAIR, &["--set", argument]);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert_says(&lines, &format!("corotate: --set {shown}"), &[reason, "write --set key=value"]);
    }
}

#[test]
fn an_override_is_checked_as_a_file_is_and_named_as_the_place() {
    for (argument, key, parts) in [
        ("tick_herz=1000", "tick_herz", ["unknown key", "did you mean `tick_hz`?"]),
        ("zzz=1", "zzz", ["unknown key", "known here"]),
        ("a.b.c=1", "a", ["unknown key", "known here"]),
        ("leader.inertia=[1,2,2.5]", "leader.inertia", ["unknown key", "did you mean `inertia_kg_m2`?"]),
        ("observer.x.y.z=1", "observer.x", ["unknown key", "known here"]),
        ("accept.foo=1", "accept.foo", ["unknown criterion", "known here"]),
        ("tick_hz=0", "tick_hz", ["outside", "give a rate"]),
        ("tick_hz=1e", "tick_hz", ["got string", "give a number"]),
        ("duration_s=nan", "duration_s", ["not a finite number", "give"]),
        ("leader.inertia_kg_m2.1=inf", "leader.inertia_kg_m2[1]", ["not a finite number", "give"]),
        ("leader.inertia_kg_m2[1]=inf", "leader.inertia_kg_m2[1]", ["not a finite number", "give"]),
        ("leader.inertia_kg_m2=[1,1,1]", "leader.inertia_kg_m2", ["sphere", "differ"]),
        ("leader.measured_axes=[1,1]", "leader.measured_axes", ["exactly one", "name two"]),
        ("leader=1", "leader", ["got integer", "give a table"]),
        ("leader={}", "leader.inertia_kg_m2", ["is missing", "add it"]),
        ("follower.0=3", "follower[0]", ["got integer", "give a table"]),
        ("follower.0.name=observer", "follower[0].name", ["taken", "choose another"]),
        ("follower[0].name=observer", "follower[0].name", ["taken", "choose another"]),
        ("realtime.cores=fast", "realtime.cores", ["no such choice", "give"]),
        ("rig=rigidbody", "rig", ["there is no rig", "did you mean `rigid-body`?"]),
        ("clock=fast", "clock", ["no choice `fast`", "known here"]),
    ] {
        assert_says(&refused(PAIR, &["--set", argument]), &format!("corotate: --set {argument}: {key}: "), &parts);
    }
    let last = refused(PAIR, &["--set", "tick_hz=0", "--set", "tick_hz=-1", "--json"]);
    assert_says(&last, "corotate: --set tick_hz=-1: tick_hz: ", &["outside"]);
    assert_eq!(last.len(), 1, "the first is overridden: {last:?}");
}

#[test]
fn options_are_checked_as_their_keys_are() {
    for (option, value, key, parts) in [
        ("--clock", "nonsense", "clock", ["no choice `nonsense`", "known here"]),
        ("--clock", "1", "clock", ["got", "give"]),
        ("--clock", "", "clock", ["neither TOML", "write"]),
        ("--duration", "nan", "duration_s", ["not a finite number", "give"]),
        ("--duration", "inf", "duration_s", ["not a finite number", "give"]),
        ("--duration", "0", "duration_s", ["ticks", "give a length"]),
        ("--duration", "-1", "duration_s", ["ticks", "give a length"]),
        ("--duration", "10s", "duration_s", ["got string \"10s\"", "give a number"]),
        ("--tick-hz", "0", "tick_hz", ["outside", "give a rate"]),
        ("--tick-hz", "-5", "tick_hz", ["outside", "give a rate"]),
        ("--tick-hz", "fast", "tick_hz", ["got string", "give a number"]),
        ("--external", "nosuch", "--external nosuch", ["no such role", "has: leader, follower, observer, controller"]),
        ("--external", "", "--external", ["no such role", "has: leader"]),
    ] {
        assert_says(&refused(PAIR, &[option, value]), "corotate: ", &[key, parts[0], parts[1]]);
    }
    let alone = refused(PAIR, &["--external", "follower", "--clock", "in-process"]);
    assert_says(&alone, "corotate: --external follower: ", &["one process", "give --clock realtime or lockstep"]);
}

#[cfg(not(feature = "foxglove"))]
#[test]
fn foxglove_that_was_left_out_of_the_build_is_refused() {
    for arguments in [&["run", "--foxglove"][..], &["run", "--foxglove", "0.0.0.0:9000"], &["foxglove"]] {
        let done = refused_in(&Bench::new(), arguments);
        assert!(done.stderr.contains("build it with `cargo build --release --features foxglove`"), "{done:?}");
    }
}

#[cfg(not(feature = "parquet"))]
#[test]
fn parquet_that_was_left_out_of_the_build_is_refused() {
    let bench = Bench::new();
    for options in [&["--parquet", "tables"][..], &["--csv", "tables", "--parquet", "tables"]] {
        let done = refused_in(&bench, &[&["export", "nosuch.mcap"], options].concat());
        assert!(done.stderr.contains("--parquet: this program was built without Parquet; build it with"), "{done:?}");
        assert!(done.stderr.contains("`cargo build --release --features parquet`"), "{done:?}");
        assert!(!bench.path("tables").exists());
    }
}

#[test]
fn a_command_line_that_makes_no_sense_is_refused() {
    let bench = Bench::new();
    let path = bench.path("");
    let pair = shipped("rigid-pair").display().to_string();
    let cases: [(&[&str], &str, &str); 26] = [
        (&["nosuch"], "unrecognized subcommand 'nosuch'", "--help"),
        (&["--nosuch"], "unexpected argument '--nosuch'", "--help"),
        (&[""], "unrecognized subcommand", "--help"),
        (&["run", "--nosuch"], "unexpected argument '--nosuch'", "--help"),
        (&["run", "a.toml", "b.toml"], "unexpected argument 'b.toml'", "--help"),
        (&["run", "--set"], "a value is required for '--set <KEY=VALUE>'", "--help"),
        (&["run", "--external", "x"], "no such role", "has: leader"),
        (&["run", "--set", "tick_herz=1"], "--set tick_herz=1", "did you mean"),
        (&["check"], "<FILES>", "--help"),
        (&["seat"], "<FILE>", "--help"),
        (&["seat", "nosuch.toml"], "<ROLE>", "--help"),
        (&["seat", "nosuch.toml", "leader"], "nosuch.toml: cannot be read", "give the path of a scenario file"),
        (&["seat", &pair, "nosuch"], "no role `nosuch`", "it has: leader, follower, observer, controller"),
        (&["seat", &pair, "leader", "--clock", "in-process"], "no seats", "give --clock realtime or lockstep"),
        (&["seat", &pair, "leader", "--domain", "/nonexistent"], "not the domain of a run", "`corotate run` prints it"),
        (&["init"], "<NAME>", "--help"),
        (&["init", "nosuch"], "no scenario `nosuch`", "there are: rigid-pair"),
        (&["init", ""], "no scenario ``", "there are: rigid-pair"),
        (&["plant"], "--domain <DIR>", "--help"),
        (&["plant", "--domain", "/nonexistent"], "--body <NAME>", "--help"),
        (
            &["plant", "--domain", "/nonexistent", "--body", "leader"],
            "not the domain of a run",
            "`corotate run` prints it",
        ),
        (&["observer", "--domain", "/nonexistent"], "not the domain of a run", "`corotate run` prints it"),
        (&["observer", "--domain", path.to_str().unwrap()], "not the domain of a run", "`corotate run` prints it"),
        (&["export", "nosuch.mcap"], "<--csv <DIR>|--parquet <DIR>>", "--help"),
        (&["controller", "--domain", "."], "not the domain of a run", "`corotate run` prints it"),
        (&["controller", "--domain", ""], "a value is required for '--domain <DIR>'", "--help"),
    ];
    for (arguments, reason, remedy) in cases {
        let done = refused_in(&bench, arguments);
        assert!(done.stdout.is_empty() && done.stderr.contains(reason) && done.stderr.contains(remedy), "{done:?}");
    }
}

#[test]
fn check_prints_the_good_among_the_bad() {
    let bench = Bench::new();
    std::fs::write(bench.path("good.toml"), PAIR).unwrap();
    let bad = with(PAIR, "tick_hz", "0");
    std::fs::write(bench.path(FILE), &bad).unwrap();
    let alone = bench.run(&["check", "good.toml"]);
    assert_eq!((alone.code, alone.stderr.as_str()), (Some(0), ""));
    for files in [["good.toml", FILE], [FILE, "good.toml"]] {
        let done = refused_in(&bench, &["check", files[0], files[1]]);
        assert_eq!(done.stdout, alone.stdout);
        assert!(done.stderr.starts_with(&format!("corotate: {}: tick_hz: ", place(&bad, "tick_hz"))), "{done:?}");
    }
}

#[test]
fn what_check_prints_is_the_scenario_it_checked() {
    let bench = Bench::new();
    for (name, text) in SHIPPED {
        let path = shipped(name);
        let done = bench.run(&["check", path.to_str().unwrap()]);
        assert_eq!((done.code, done.stderr.as_str()), (Some(0), ""), "{name}");
        let resolved = Scenario::load(&path, &[]).unwrap().to_toml();
        assert_eq!(Scenario::parse(&done.stdout, name, &[]).unwrap().to_toml(), resolved);
        assert_eq!(Scenario::parse(&resolved, name, &[]).unwrap().to_toml(), resolved);
        assert_eq!(Scenario::parse(text, name, &[]).unwrap().to_toml(), resolved, "as built in");
    }
}

#[test]
fn a_stdout_that_takes_nothing_is_a_failure_and_no_panic() {
    let pair = shipped("rigid-pair");
    for arguments in [["init", "rigid-pair"], ["check", pair.to_str().unwrap()]] {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output = Bench::new().command().args(arguments).stdout(full).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.starts_with("corotate: cannot write to stdout: "), "{stderr}");
    }
}

/// One way in which a text goes wrong.
#[derive(Debug, Clone)]
enum Slip {
    DeleteLine(Index),
    RepeatLine(Index, Index),
    ReplaceLine(Index, String),
    ReplaceByte(Index, u8),
    ReplaceNumber(Index, &'static str),
    Cut(Index),
}

impl Slip {
    fn spoil(&self, text: &str) -> String {
        let mut lines: Vec<&str> = text.lines().collect();
        if lines.is_empty() {
            return String::new();
        }
        match self {
            Self::DeleteLine(at) => {
                lines.remove(at.index(lines.len()));
            }
            Self::RepeatLine(from, to) => lines.insert(to.index(lines.len()), lines[from.index(lines.len())]),
            Self::ReplaceLine(at, line) => {
                let at = at.index(lines.len());
                lines[at] = line;
            }
            Self::ReplaceByte(at, byte) => {
                let mut bytes = text.as_bytes().to_vec();
                bytes[at.index(text.len())] = *byte;
                return String::from_utf8_lossy(&bytes).into_owned();
            }
            Self::ReplaceNumber(at, number) => return replace_number(text, at, number),
            Self::Cut(at) => return String::from_utf8_lossy(&text.as_bytes()[..at.index(text.len())]).into_owned(),
        }
        lines.join("\n")
    }
}

/// The text with one of the numbers that stand after ` = ` or in a list replaced.
fn replace_number(text: &str, at: &Index, number: &str) -> String {
    let begins = |(offset, c): &(usize, char)| c.is_ascii_digit() && text[..*offset].ends_with([' ', '[', '-']);
    let begin: Vec<usize> = text.char_indices().filter(begins).map(|(offset, _)| offset).collect();
    if begin.is_empty() {
        return text.to_owned();
    }
    let (before, rest) = text.split_at(begin[at.index(begin.len())]);
    let after = rest.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.' || c == 'e' || c == '-');
    format!("{before}{number}{after}")
}

fn number() -> impl Strategy<Value = &'static str> {
    let numbers = "0 -1 1 2 3 1e3 1e-3 1e9 1e308 1e-320 1e400 nan inf -inf 0x7fff 1_000 9223372036854775807 \
                   -9223372036854775808 18446744073709551615 99999999999999999999";
    let others = "\"1\" true [] [[]] {} 1979-05-27 ' ,";
    select(numbers.split(' ').chain(others.split(' ')).collect::<Vec<_>>())
}

fn slip() -> impl Strategy<Value = Slip> {
    prop_oneof![
        1 => any::<Index>().prop_map(Slip::DeleteLine),
        1 => any::<(Index, Index)>().prop_map(|(from, to)| Slip::RepeatLine(from, to)),
        1 => (any::<Index>(), "\\PC{0,30}").prop_map(|(at, line)| Slip::ReplaceLine(at, line)),
        1 => any::<(Index, u8)>().prop_map(|(at, byte)| Slip::ReplaceByte(at, byte)),
        3 => (any::<Index>(), number()).prop_map(|(at, number)| Slip::ReplaceNumber(at, number)),
        1 => any::<Index>().prop_map(Slip::Cut),
    ]
}

/// Overrides of keys that exist, of such that do not, and of nothing that can be read.
fn argument() -> impl Strategy<Value = String> {
    let key = prop_oneof![
        select(keys()),
        select(vec!["leader", "follower", "follower.0", "accept.missed_ticks_max"]).prop_map(str::to_owned),
        "[a-z_.\\[\\]0-9]{0,12}",
    ];
    let value = prop_oneof![number().prop_map(str::to_owned), "\\PC{0,10}", "\\[[0-9., -]{0,12}\\]"];
    prop_oneof![9 => (key, value).prop_map(|(key, value)| format!("{key}={value}")), 1 => any::<String>()]
}

/// The shipped texts, spoilt; now and then not at all, so that overrides alone are at fault.
fn spoilt() -> impl Strategy<Value = String> {
    let text = select(SHIPPED.map(|(_, text)| text).to_vec());
    (text, prop::collection::vec(slip(), 0..4))
        .prop_map(|(text, slips)| slips.iter().fold(text.to_owned(), |text, slip| slip.spoil(&text)))
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 200,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(0x0bad_f11e),
        ..ProptestConfig::default()
    })]

    #[test]
    fn whatever_the_text_and_the_overrides_the_answer_is_a_scenario_or_a_message(
        text in spoilt(),
        overrides in prop::collection::vec(argument(), 0..3),
    ) {
        match Scenario::parse(&text, FILE, &overrides) {
            Ok(scenario) => {
                let resolved = scenario.to_toml();
                prop_assert_eq!(Scenario::parse(&resolved, FILE, &[]).unwrap().to_toml(), resolved);
            }
            Err(error) => {
                let message = error.to_string();
                prop_assert!(!message.is_empty());
                for line in message.lines() {
                    prop_assert!(line.starts_with(FILE) || line.starts_with("--set "), "{}", line);
                    prop_assert!(line.len() < 5000 && !line.contains(char::is_control), "{}", line);
                }
            }
        }
    }

    #[test]
    fn whatever_the_bytes_the_answer_is_a_message(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let message = Scenario::parse(&String::from_utf8_lossy(&bytes), FILE, &[]).unwrap_err().to_string();
        prop_assert!(message.starts_with(FILE), "{}", message);
    }
}
