//! Texts that are not scenarios: wrong types, names, tables and syntax.

use super::{
    FILE, PAIR, assert_refused, assert_says, assert_suggests, keys, line, line_of, place, refused, refused_in, replace,
    split, with, without_table,
};
use crate::common::{Bench, code_of};

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
                let start = format!("corotate: {}: {key}", place(&text, &key));
                assert!(lines[0].starts_with(&start) && code_of(&lines[0]).is_some(), "{key} = {wrong}: {lines:?}");
                let jargon = ["f64", "u64", "i32", "usize", "struct", "sequence", "map", "variant", "invalid type"];
                assert!(!jargon.iter().any(|word| lines[0].contains(word)), "jargon: {lines:?}");
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
        let unknown = if table == Some("accept") { "unknown-criterion" } else { "unknown-key" };
        assert_suggests(&replace(PAIR, number, &[&line]), &misspelt, unknown, name);
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
        let lines = refused(&text, &[]);
        assert_says(&lines, &format!("corotate: {FILE}:"), "unknown-key");
        let named = |line: &String| line.contains(&format!(": {slip}: ")) && line.contains(&format!("`{table}`"));
        assert!(lines.iter().any(named), "{lines:?}");
    }
}

#[test]
fn an_unknown_key_is_refused_with_a_list_of_all_keys() {
    for key in
        ["zzz", "leader.zzz", "follower[0].zzz", "observer.zzz", "controller.zzz", "actuator.zzz", "realtime.zzz"]
    {
        let text = with(PAIR, key, "1");
        assert_refused(&text, key, "unknown-key");
    }
    let lines = refused(with(PAIR, "zzz", "1"), &[]);
    let known = ["leader", "follower", "observer", "controller"];
    assert!(known.iter().all(|table| lines[0].contains(table)), "{lines:?}");
    for name in [r#""a`b""#, r#""a b""#, r#""a\nb""#, r#""\u001b[31m""#] {
        let lines = refused(format!("{name} = 1\n{PAIR}"), &[]);
        assert_says(&lines, &format!("corotate: {FILE}:1: "), "unknown-key");
    }
}

#[test]
fn a_missing_key_or_table_is_named() {
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
        assert_refused(&text, key, "missing-key");
    }
    for table in ["leader", "observer", "controller"] {
        assert_refused(&without_table(table), table, "missing-key");
    }
    for empty in ["", "\n\n", "# nothing but a comment\n"] {
        let bench = Bench::new();
        std::fs::write(bench.path(FILE), empty).unwrap();
        let done = refused_in(&bench, &["run", FILE]);
        assert_eq!(done.codes(), ["missing-key"; 4]);
        let keys = ["name", "rig", "tick_hz", "duration_s"];
        let named =
            done.stderr.lines().zip(keys).all(|(line, key)| line.starts_with(&format!("corotate: {FILE}: {key}: ")));
        assert!(named && done.stderr.lines().count() == keys.len(), "{done:?}");
    }
}

#[test]
fn a_key_or_table_that_appears_twice_is_refused() {
    for key in keys() {
        let number = line_of(PAIR, &key).unwrap();
        let line = line(number);
        let lines = refused(replace(PAIR, number, &[line, line]), &[]);
        assert_says(&lines, &format!("corotate: {FILE}:{}:1: ", number + 1), "duplicate-key");
        assert!(lines[0].contains(&format!("`{}`", split(&key).1)), "{lines:?}");
    }
    for table in ["leader", "observer", "controller", "actuator", "realtime", "launch", "accept"] {
        let lines = refused(format!("{PAIR}[{table}]\n"), &[]);
        let start = format!("corotate: {FILE}:{}:2: ", PAIR.lines().count() + 1);
        assert_says(&lines, &start, "duplicate-key");
        assert!(lines[0].contains(&format!("`{table}`")), "{lines:?}");
    }
}

#[test]
fn a_table_and_a_list_are_not_interchangeable() {
    for table in ["leader", "observer", "controller", "actuator", "realtime", "launch", "accept"] {
        let listed = PAIR.replace(&format!("\n[{table}]"), &format!("\n[[{table}]]"));
        let start = format!("corotate: {FILE}:{}: {table}: ", line_of(PAIR, table).unwrap());
        assert_says(&refused(&listed, &[]), &start, "wrong-type");
        let plain = format!("{table} = 3\n{}", without_table(table));
        assert_refused(&plain, table, "wrong-type");
    }
    // Values without keys, in the order of the program's own structures.
    let bare = format!("leader = [[1.0, 2.0, 2.5], [0.6, -0.4, 0.8], [1, 2]]\n{}", without_table("leader"));
    assert_refused(&bare, "leader", "wrong-type");
    let single = PAIR.replace("[[follower]]", "[follower]");
    assert_refused(&single, "follower", "wrong-type");
    let word = format!("follower = \"one\"\n{}", without_table("follower[0]"));
    assert_refused(&word, "follower", "wrong-type");
    let limit = "accept.sync_error_rad_s_max";
    assert_refused(&with(PAIR, limit, "{ x = 1 }"), limit, "wrong-type");
}

#[test]
fn the_line_is_right_for_every_layout() {
    let at = line_of(PAIR, "leader.inertia_kg_m2").unwrap();
    let spread = replace(PAIR, at, &["inertia_kg_m2 = [", "  1.0,", "  nan,", "  2.5,", "]"]);
    assert_says(
        &refused(&spread, &[]),
        &format!("corotate: {FILE}:{}: leader.inertia_kg_m2[1]: ", at + 2),
        "not-finite",
    );
    let below = with(&replace(PAIR, at, &["inertia_kg_m2 = [1.0,", "  2.0, 2.5]"]), "launch.startup_timeout_s", "0");
    assert_refused(&below, "launch.startup_timeout_s", "out-of-range");
    let tick = with(PAIR, "tick_hz", "0");
    for text in [tick.replace('\n', "\r\n"), format!("\u{feff}{tick}"), format!("{}{tick}", "\n".repeat(5000))] {
        let number = 1 + text.lines().position(|line| line.starts_with("tick_hz")).unwrap();
        assert_says(&refused(&text, &[]), &format!("corotate: {FILE}:{number}: tick_hz: "), "out-of-range");
    }
}

#[test]
fn invalid_toml_is_refused_at_its_line() {
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
        assert_says(&lines, &format!("corotate: {FILE}:{number}:"), "syntax");
    }
}

#[test]
fn invalid_utf8_is_refused_at_its_line() {
    let bytes: Vec<u8> = (0..=255).cycle().take(4096).collect();
    assert_says(&refused(bytes, &[]), &format!("corotate: {FILE}:2:"), "not-utf8");
    assert_says(&refused(b"name = \"\xff\"\n", &[]), &format!("corotate: {FILE}:1:9: "), "not-utf8");
    let wide: Vec<u8> = PAIR.encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert_says(&refused(wide, &[]), &format!("corotate: {FILE}:"), "syntax");
    let program = std::fs::read(env!("CARGO_BIN_EXE_corotate")).unwrap();
    let program = &program[..100_000];
    let text = &program[..std::str::from_utf8(program).unwrap_err().valid_up_to()];
    let line = 1 + text.iter().filter(|byte| **byte == b'\n').count();
    assert_says(&refused(program, &[]), &format!("corotate: {FILE}:{line}:"), "not-utf8");
    assert_says(&refused(format!("{PAIR}\0"), &[]), &format!("corotate: {FILE}:"), "syntax");
}

#[test]
fn deep_nesting_is_handled() {
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
        assert_says(&refused(text + PAIR, &[]), &format!("corotate: {FILE}"), "syntax");
    }
    let just_so = format!("x = {}{}\n{PAIR}", "[".repeat(60), "]".repeat(60));
    assert_refused(&just_so, "x", "unknown-key");
}

#[test]
fn long_lines_are_handled() {
    let long = "x".repeat(900_000);
    let comment = format!("# {long}\n{}", with(PAIR, "tick_hz", "0"));
    assert_refused(&comment, "tick_hz", "out-of-range");
    assert_refused(&with(PAIR, "name", &format!("\"{long}\"")), "name", "bad-name");
    assert_says(&refused(format!("{long} = 1\n{PAIR}"), &[]), &format!("corotate: {FILE}:1: x"), "unknown-key");
    let axes = format!("[{}]", "1,".repeat(400_000));
    assert_refused(&with(PAIR, "leader.measured_axes", &axes), "leader.measured_axes", "bad-axes");
    let moments = format!("[{}]", "1.0,".repeat(200_000));
    assert_refused(&with(PAIR, "leader.inertia_kg_m2", &moments), "leader.inertia_kg_m2", "wrong-length");
    assert_says(&refused(with(PAIR, "tick_hz", &"9".repeat(900_000)), &[]), "corotate: ", "syntax");
    assert_says(&refused("#".repeat(2_000_000), &[]), &format!("corotate: {FILE}: "), "cannot-read-scenario");
}
