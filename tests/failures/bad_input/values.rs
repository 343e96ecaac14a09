//! Invalid values: the range of each key.

use super::{
    FILE, PAIR, assert_all_refused, assert_refused, assert_says, assert_suggests, keys, line, line_of, place, refused,
    with, without_table,
};
use crate::common::shipped;
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;

#[test]
fn an_invalid_name_rig_or_clock_is_refused() {
    let long = format!("\"{}\"", "a".repeat(200));
    assert_refused(&with(PAIR, "name", &long), "name", "bad-name");
    assert_refused(&with(PAIR, "follower[0].name", &long), "follower[0].name", "bad-name");
    assert_all_refused(&[
        ("name", "\"\"", "bad-name"),
        ("name", "\"a/b\"", "bad-name"),
        ("name", "\"../up\"", "bad-name"),
        ("name", "\"Pair\"", "bad-name"),
        ("name", "\"a b\"", "bad-name"),
        ("name", r#""a\nb""#, "bad-name"),
        ("name", r#""\u001b[31m""#, "bad-name"),
        ("name", r#""a\u0000b""#, "bad-name"),
        ("rig", "\"rigid-bodi\"", "unknown-rig"),
        ("rig", "\"pendulum\"", "unknown-rig"),
        ("rig", "\"\"", "unknown-rig"),
        ("clock", "\"fast\"", "unknown-choice"),
        ("clock", "\"lokstep\"", "unknown-choice"),
        ("clock", "1", "wrong-type"),
    ]);
}

#[test]
fn a_misspelt_word_is_refused_with_a_suggestion() {
    for (key, value, code, meant) in [
        ("rig", "\"rigid-bodi\"", "unknown-rig", "rigid-body"),
        ("clock", "\"lokstep\"", "unknown-choice", "lockstep"),
        ("accept.starved_ticks_max", "{ controler = 1 }", "unknown-role", "controller"),
        ("accept.sync_eror_rad_s_max", "1", "unknown-criterion", "sync_error_rad_s_max"),
        ("accept.sync_error_rad_s", "1", "unknown-criterion", "sync_error_rad_s_max"),
    ] {
        assert_suggests(&with(PAIR, key, value), key, code, meant);
    }
}

#[test]
fn a_tick_rate_or_duration_out_of_range_is_refused() {
    assert_all_refused(&[
        ("tick_hz", "0", "out-of-range"),
        ("tick_hz", "0.0", "out-of-range"),
        ("tick_hz", "-0.0", "out-of-range"),
        ("tick_hz", "-1000.0", "out-of-range"),
        ("tick_hz", "0.09", "out-of-range"),
        ("tick_hz", "100001", "out-of-range"),
        ("tick_hz", "1e9", "out-of-range"),
        ("duration_s", "0", "out-of-range"),
        ("duration_s", "-1", "out-of-range"),
        ("duration_s", "1e-9", "out-of-range"),
        ("duration_s", "1e11", "out-of-range"),
    ]);
}

#[test]
fn an_invalid_tick_rate_gives_one_message_only() {
    for tick_hz in ["0", "-5", "0.01", "1e-9", "1e7"] {
        assert_eq!(refused(with(PAIR, "tick_hz", tick_hz), &[]).len(), 1, "{tick_hz}");
        for (name, text) in SHIPPED {
            let message = Scenario::parse(&with(text, "tick_hz", tick_hz), FILE, &[]).unwrap_err().to_string();
            assert_eq!(message.lines().count(), 1, "{name} at {tick_hz} Hz: {message}");
        }
    }
}

#[test]
fn an_invalid_duration_gives_one_message_only() {
    for duration_s in ["0", "-5", "1e-9", "1e12"] {
        assert_eq!(refused(with(PAIR, "duration_s", duration_s), &[]).len(), 1, "{duration_s}");
        for (name, text) in SHIPPED {
            let message = Scenario::parse(&with(text, "duration_s", duration_s), FILE, &[]).unwrap_err().to_string();
            assert_eq!(message.lines().count(), 1, "{name} for {duration_s} s: {message}");
        }
    }
}

#[test]
fn a_leader_without_exactly_one_hidden_axis_is_refused() {
    assert_all_refused(&[
        ("leader.inertia_kg_m2", "[0.0, 2.0, 2.5]", "no-such-inertia"),
        ("leader.inertia_kg_m2", "[1.0, -2.0, 2.5]", "no-such-inertia"),
        ("leader.inertia_kg_m2", "[1.0, 2.0, 3.5]", "triangle-inequality"),
        ("leader.inertia_kg_m2", "[2.0, 2.0, 2.0]", "spherical-body"),
        ("leader.inertia_kg_m2", "[1.0, 1.000000000001, 1.000000000002]", "unobservable-axis"),
        ("leader.inertia_kg_m2", "[1.0, 2.0]", "wrong-length"),
        ("leader.inertia_kg_m2", "[1.0, 2.0, 2.5, 1.0]", "wrong-length"),
        ("leader.inertia_kg_m2", "[]", "wrong-length"),
        ("leader.inertia_kg_m2", "1.0", "wrong-type"),
        ("leader.inertia_kg_m2", "[1.0, \"2.0\", 2.5]", "wrong-type"),
        ("leader.initial_rate_rad_s", "[0.6, -0.4]", "wrong-length"),
        ("leader.measured_axes", "[]", "bad-axes"),
        ("leader.measured_axes", "[2]", "bad-axes"),
        ("leader.measured_axes", "[1, 1]", "bad-axes"),
        ("leader.measured_axes", "[0, 1]", "bad-axes"),
        ("leader.measured_axes", "[1, 4]", "bad-axes"),
        ("leader.measured_axes", "[1, 2, 3]", "bad-axes"),
        ("leader.measured_axes", "[1, 2, 2]", "bad-axes"),
        ("leader.measured_axes", "[1, -2]", "wrong-type"),
        ("leader.measured_axes", "[1.0, 2.0]", "wrong-type"),
        ("leader.measured_axes", "\"1, 2\"", "wrong-type"),
    ]);
}

#[test]
fn every_shipped_scenario_refuses_an_unknown_axis() {
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
fn criteria_are_not_checked_without_a_valid_rig() {
    for (key, value) in [("leader.inertia_kg_m2", "[0.0, 2.0, 2.5]"), ("leader.measured_axes", "[]"), ("rig", "\"x\"")]
    {
        assert_eq!(refused(with(PAIR, key, value), &[]).len(), 1, "{key}");
    }
}

#[test]
fn follower_names_must_be_unique() {
    assert_all_refused(&[
        ("follower[0].name", "\"\"", "bad-name"),
        ("follower[0].name", "\"Leader One\"", "bad-name"),
        ("follower[0].name", "\"a/b\"", "bad-name"),
        ("follower[0].name", "\"leader\"", "taken-name"),
        ("follower[0].name", "\"observer\"", "taken-name"),
        ("follower[0].name", "\"controller\"", "taken-name"),
        ("follower[0].initial_rate_rad_s", "[0.1]", "wrong-length"),
    ]);
    let twins = format!("{PAIR}\n[[follower]]\nname = \"follower\"\ninitial_rate_rad_s = [0.0, 0.0, 0.0]\n");
    assert_refused(&twins, "follower[1].name", "taken-name");
}

#[test]
fn a_run_without_followers_or_with_too_many_is_refused() {
    let none = without_table("follower[0]");
    for text in [format!("follower = []\n{none}"), none] {
        assert_says(&refused(text, &[]), &format!("corotate: {FILE}"), "unused-key");
    }
    let more: String = (0..2000)
        .map(|index| format!("[[follower]]\nname = \"f{index}\"\ninitial_rate_rad_s = [0.0, 0.0, 0.0]\n"))
        .collect();
    assert_says(&refused(format!("{PAIR}\n{more}"), &[]), "corotate: bad.toml:18: follower: 2001 ", "too-many");
}

#[test]
fn unusable_observers_and_controllers_are_refused() {
    assert_all_refused(&[
        ("observer.decay_rate_per_s", "0", "not-positive"),
        ("observer.decay_rate_per_s", "-6.0", "not-positive"),
        ("observer.initial_guess_rad_s", "1e9", "ambiguous-phase"),
        ("observer.initial_guess_rad_s", "-1e9", "ambiguous-phase"),
        ("observer.observability_floor_rad_s", "0.0", "not-positive"),
        ("observer.observability_floor_rad_s", "-1e-6", "not-positive"),
        ("observer.observability_floor_rad_s", "100.0", "never-observed"),
        ("controller.gain_per_s", "[0.0, 4.0, 4.0]", "not-positive"),
        ("controller.gain_per_s", "[4.0, 4.0, -4.0]", "not-positive"),
        ("controller.gain_per_s", "[4.0, 1000.0, 4.0]", "unstable-loop"),
        ("controller.gain_per_s", "[4.0, 1e9, 4.0]", "unstable-loop"),
        ("controller.gain_per_s", "[4.0, 4.0]", "wrong-length"),
        ("controller.gain_per_s", "4.0", "wrong-type"),
        ("controller.predict", "1", "wrong-type"),
    ]);
}

#[test]
fn a_turn_too_far_for_one_tick_is_refused() {
    let fast = with(PAIR, "leader.initial_rate_rad_s", "[60.0, -40.0, 80.0]");
    assert_refused(&with(&fast, "tick_hz", "0.2"), "tick_hz", "ambiguous-phase");
    let fast = with(PAIR, "follower[0].initial_rate_rad_s", "[1e9, 0.0, 0.0]");
    assert_refused(&fast, "follower[0].initial_rate_rad_s", "turns-too-far");
    // On a hyperbola the phase is not periodic, but no follower could track such a motion either.
    let hyperbolic = std::fs::read_to_string(shipped("rigid-pair-hyperbolic")).unwrap();
    let fast = with(&hyperbolic, "leader.initial_rate_rad_s", "[1e5, 1e5, 1e5]");
    assert_refused(&fast, "tick_hz", "ambiguous-phase");
    let wild = with(&hyperbolic, "observer.initial_guess_rad_s", "1e9");
    assert_refused(&wild, "observer.initial_guess_rad_s", "ambiguous-phase");
}

#[test]
fn actuator_realtime_and_launch_keys_out_of_range_are_refused() {
    assert_all_refused(&[
        ("actuator.command_timeout_ticks", "0", "out-of-range"),
        ("actuator.command_timeout_ticks", "-1", "wrong-type"),
        ("actuator.command_timeout_ticks", "1.5", "wrong-type"),
        ("actuator.rearm", "\"never\"", "unknown-choice"),
        ("realtime.priority", "100", "out-of-range"),
        ("realtime.priority", "-3", "out-of-range"),
        ("realtime.priority", "80.0", "wrong-type"),
        ("realtime.priority", "99999999999", "wrong-type"),
        ("realtime.cores", "[]", "bad-cores"),
        ("realtime.cores", "[5000]", "bad-cores"),
        ("realtime.cores", "\"fastest\"", "no-such-value"),
        ("realtime.cores", "[-1]", "no-such-value"),
        ("realtime.cores", "[0.5]", "no-such-value"),
        ("realtime.cores", "3", "no-such-value"),
        ("realtime.lock_memory", "\"yes\"", "wrong-type"),
        ("realtime.wake_lead_us", "-1", "out-of-range"),
        ("realtime.wake_lead_us", "1e9", "out-of-range"),
        ("realtime.spin_us", "-1", "out-of-range"),
        ("realtime.spin_us", "1e9", "out-of-range"),
        ("realtime.cutoff", "0", "out-of-range"),
        ("realtime.cutoff", "2", "out-of-range"),
        ("realtime.cutoff", "-0.5", "out-of-range"),
        ("launch.startup_timeout_s", "0", "out-of-range"),
        ("launch.startup_timeout_s", "-1", "out-of-range"),
        ("launch.startup_timeout_s", "1e9", "out-of-range"),
        ("launch.external_timeout_s", "0", "out-of-range"),
        ("launch.external_timeout_s", "-1", "out-of-range"),
        ("launch.external_timeout_s", "1e9", "out-of-range"),
        ("launch.external_timeout_s", "\"long\"", "wrong-type"),
        ("launch.external", "\"follower\"", "wrong-type"),
        ("launch.external", "[1]", "wrong-type"),
        ("launch.external", "[\"nosuch\"]", "unknown-role"),
        ("launch.external", "[\"follower\", \"\"]", "unknown-role"),
    ]);
    let alone = with(&with(PAIR, "launch.external", "[\"follower\"]"), "clock", "\"in-process\"");
    assert_refused(&alone, "launch.external", "one-process");
}

#[test]
fn unknown_and_unattainable_criteria_are_refused() {
    assert_all_refused(&[
        ("accept.settled_by_s", "-1", "negative"),
        ("accept.settled_by_s", "\"8 s\"", "wrong-type"),
        ("accept.sync_error_rad_s_max", "-1e-6", "negative"),
        ("accept.missed_ticks_max", "0.5", "not-whole"),
        ("accept.missed_ticks_max", "-1", "negative"),
        ("accept.missed_ticks_max", "1e300", "absurd-number"),
        ("accept.missed_ticks_max", "\"0\"", "out-of-range"),
        ("accept.safe_ticks_max", "\"101 %\"", "out-of-range"),
        ("accept.starved_ticks_max", "true", "no-such-value"),
        ("accept.starved_ticks_max", "{ controler = 1 }", "unknown-role"),
        ("accept.safe_ticks_max", "{ controller = 1 }", "unknown-role"),
        ("accept.missed_ticks_max", "{ controller = { x = 1 } }", "one-limit"),
        ("accept.missed_ticks_max", "{ controller = -1 }", "negative"),
        ("accept.unscored_ticks_max", "{ leader = 1 }", "one-limit"),
        ("accept.step_latency_p99_us_max", "-3", "negative"),
        ("accept.age_max_us", "-3", "negative"),
        ("accept.late_ticks_max", "0.5", "not-whole"),
        ("accept.late_ticks_max", "{ controler = 1 }", "unknown-role"),
        ("realtime.late_us", "-1", "out-of-range"),
        ("accept.age_p50_us_max", "1", "unknown-criterion"),
        ("accept.sync_eror_rad_s_max", "1", "unknown-criterion"),
        ("accept.sync_error_rad_s", "1", "unknown-criterion"),
        ("accept.foo", "1", "unknown-criterion"),
        ("accept._max", "1", "unknown-criterion"),
    ]);
}

/// Returns the values of a key with each of its numbers replaced in turn.
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
fn infinite_undefined_and_absurd_numbers_are_refused_everywhere() {
    for key in keys() {
        for number in ["nan", "inf", "-inf"] {
            for value in with_number(&key, number) {
                assert_refused(&with(PAIR, &key, &value), &key, "not-finite");
            }
        }
        for number in ["1e308", "-1e308", "1e-320"] {
            for value in with_number(&key, number).into_iter().take(1) {
                assert_refused(&with(PAIR, &key, &value), &key, "absurd-number");
            }
        }
    }
    for key in ["accept.missed_ticks_max", "accept.lateness_p99_us_max", "accept.foo"] {
        for number in ["nan", "inf", "-inf"] {
            assert_refused(&with(PAIR, key, number), key, "not-finite");
        }
    }
}

#[test]
fn a_number_that_does_not_fit_is_refused_at_its_line() {
    for (key, number) in [
        ("tick_hz", "1e400"),
        ("tick_hz", "-1e999999999999"),
        ("duration_s", "99999999999999999999"),
        ("actuator.command_timeout_ticks", "9223372036854775808"),
        ("realtime.priority", "-99999999999999999999"),
    ] {
        let text = with(PAIR, key, number);
        assert_says(&refused(&text, &[]), &format!("corotate: {}:", place(&text, key)), "syntax");
    }
}
