//! Values that make no sense: what each key can be.

use super::{
    FILE, PAIR, assert_all_refused, assert_refused, assert_says, keys, line, line_of, place, refused, with,
    without_table,
};
use crate::common::shipped;
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;

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
fn nothing_else_is_said_of_a_length_that_cannot_be() {
    for duration_s in ["0", "-5", "1e-9", "1e12"] {
        assert_eq!(refused(with(PAIR, "duration_s", duration_s), &[]).len(), 1, "{duration_s}");
        for (name, text) in SHIPPED {
            let message = Scenario::parse(&with(text, "duration_s", duration_s), FILE, &[]).unwrap_err().to_string();
            assert_eq!(message.lines().count(), 1, "{name} for {duration_s} s: {message}");
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
        (
            "leader.inertia_kg_m2",
            "[1.0, 1.000000000001, 1.000000000002]",
            "rounding",
            "times as large, or lower tick_hz",
        ),
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
        ("accept.settled_by_s", "\"8 s\"", "got string", "give a number"),
        ("accept.sync_error_rad_s_max", "-1e-6", "below zero", "give 0 or more"),
        ("accept.missed_ticks_max", "0.5", "no count of ticks", "give a whole number"),
        ("accept.missed_ticks_max", "-1", "below zero", "give 0 or more"),
        ("accept.missed_ticks_max", "1e300", "no quantity", "give"),
        ("accept.missed_ticks_max", "\"0\"", "no share of ticks", "a number of ticks"),
        ("accept.safe_ticks_max", "\"101 %\"", "no share of ticks", "from \"0 %\" to \"100 %\""),
        ("accept.starved_ticks_max", "true", "no limit on ticks", "give a number, a share"),
        ("accept.starved_ticks_max", "{ controler = 1 }", "no such role", "did you mean `controller`?"),
        ("accept.safe_ticks_max", "{ controller = 1 }", "no such role", "known here: follower"),
        ("accept.missed_ticks_max", "{ controller = { x = 1 } }", "a role has one limit", "give a number"),
        ("accept.missed_ticks_max", "{ controller = -1 }", "below zero", "give 0 or more"),
        ("accept.unscored_ticks_max", "{ leader = 1 }", "all roles together", "give a number"),
        ("accept.step_latency_p99_us_max", "-3", "below zero", "give 0 or more"),
        ("accept.sync_eror_rad_s_max", "1", "unknown criterion", "did you mean `sync_error_rad_s_max`?"),
        ("accept.sync_error_rad_s", "1", "unknown criterion", "did you mean `sync_error_rad_s_max`?"),
        ("accept.foo", "1", "unknown criterion", "known here: sync_error_rad_s_max"),
        ("accept._max", "1", "unknown criterion", "known here: sync_error_rad_s_max"),
    ]);
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
