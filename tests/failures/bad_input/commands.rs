//! Invalid files, overrides, options and command lines; and the output of `corotate check` beside them.

use super::{FILE, PAIR, assert_says, place, refused, refused_in, with};
use crate::common::{Bench, code_of, shipped};
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;

#[test]
fn a_path_without_a_file_is_refused() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("directory")).unwrap();
    std::fs::write(bench.path("file"), PAIR).unwrap();
    for command in ["run", "check"] {
        for (path, code) in [
            ("nowhere.toml", "cannot-read-scenario"),
            ("./directory", "cannot-read-scenario"),
            ("directory/nowhere.toml", "cannot-read-scenario"),
            ("file/below.toml", "cannot-read-scenario"),
            ("/dev/zero", "cannot-read-scenario"),
            ("/dev/null", "missing-key"),
        ] {
            let done = refused_in(&bench, &[command, path]);
            assert!(done.stderr.starts_with(&format!("corotate: {path}: ")) && done.says(code), "{done:?}");
            // An empty text lacks every required key.
            let findings = if path == "/dev/null" { 4 } else { 1 };
            assert!(done.stdout.is_empty() && done.stderr.lines().count() == findings, "{done:?}");
        }
    }
}

#[test]
fn a_recording_that_does_not_exist_is_refused() {
    let bench = Bench::new();
    let commands: [&[&str]; 4] = [
        &["report", "no.mcap"],
        &["replay", "no.mcap"],
        &["export", "no.mcap", "--csv", "tables"],
        &["diff", "no.mcap", "no.mcap"],
    ];
    for command in commands {
        let done = bench.run(command);
        let code = if command[0] == "report" { "no-such-run" } else { "cannot-read" };
        assert!(done.code == Some(2) && done.says(code) && done.stderr.contains("no.mcap"), "{command:?}: {done:?}");
    }
}

#[test]
fn an_override_that_cannot_be_read_is_refused() {
    let deep = format!("{}=1", vec!["a"; 60_000].join("."));
    let nested = format!("tick_hz={}", "[".repeat(100_000));
    for (argument, code) in [
        ("tick_hz", "no-equals"),
        ("", "no-equals"),
        ("=", "no-value"),
        ("=1", "empty-key"),
        (".=1", "empty-key"),
        ("tick_hz.=1", "empty-key"),
        ("leader..x=1", "empty-key"),
        ("follower.7.name=x", "no-element"),
        ("follower.1.name=x", "no-element"),
        ("follower[1].name=x", "no-element"),
        ("follower.one.name=x", "not-a-position"),
        ("follower.-1.name=x", "not-a-position"),
        ("follower.99999999999999999999.name=x", "not-a-position"),
        ("name.x=1", "plain-value"),
        ("leader.inertia_kg_m2.0.x=1", "plain-value"),
        ("tick_hz=", "no-value"),
        ("tick_hz=[1,", "no-value"),
        ("tick_hz='x", "no-value"),
        ("tick_hz=a b", "no-value"),
        ("tick_hz==5", "no-value"),
        ("tick_hz=1\nname=\"x\"", "no-value"),
        ("name=\u{1b}[31m", "no-value"),
        (&deep, "too-deep"),
        (&nested, "no-value"),
    ] {
        let shown: String = argument.chars().take_while(|c| !c.is_control()).take(100).collect();
        let lines = refused(PAIR, &["--set", argument]);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert_says(&lines, &format!("corotate: --set {shown}"), code);
    }
}

#[test]
fn an_override_is_checked_as_a_file_is_and_named_as_the_place() {
    for (argument, key, code) in [
        ("tick_herz=1000", "tick_herz", "unknown-key"),
        ("zzz=1", "zzz", "unknown-key"),
        ("a.b.c=1", "a", "unknown-key"),
        ("leader.inertia=[1,2,2.5]", "leader.inertia", "unknown-key"),
        ("observer.x.y.z=1", "observer.x", "unknown-key"),
        ("accept.foo=1", "accept.foo", "unknown-criterion"),
        ("tick_hz=0", "tick_hz", "out-of-range"),
        ("tick_hz=1e", "tick_hz", "wrong-type"),
        ("duration_s=nan", "duration_s", "not-finite"),
        ("leader.inertia_kg_m2.1=inf", "leader.inertia_kg_m2[1]", "not-finite"),
        ("leader.inertia_kg_m2[1]=inf", "leader.inertia_kg_m2[1]", "not-finite"),
        ("leader.inertia_kg_m2=[1,1,1]", "leader.inertia_kg_m2", "spherical-body"),
        ("leader.measured_axes=[1,1]", "leader.measured_axes", "bad-axes"),
        ("leader=1", "leader", "wrong-type"),
        ("leader={}", "leader.inertia_kg_m2", "missing-key"),
        ("follower.0=3", "follower[0]", "wrong-type"),
        ("follower.0.name=observer", "follower[0].name", "taken-name"),
        ("follower[0].name=observer", "follower[0].name", "taken-name"),
        ("realtime.cores=fast", "realtime.cores", "no-such-value"),
        ("rig=rigidbody", "rig", "unknown-rig"),
        ("clock=fast", "clock", "unknown-choice"),
    ] {
        assert_says(&refused(PAIR, &["--set", argument]), &format!("corotate: --set {argument}: {key}: "), code);
    }
    let last = refused(PAIR, &["--set", "tick_hz=0", "--set", "tick_hz=-1", "--json"]);
    assert_says(&last, "corotate: --set tick_hz=-1: tick_hz: ", "out-of-range");
    assert_eq!(last.len(), 1, "the first is overridden: {last:?}");
}

#[test]
fn options_are_checked_as_their_keys_are() {
    for (option, value, key, code) in [
        ("--duration", "", "duration_s", "no-value"),
        ("--duration", "nan", "duration_s", "not-finite"),
        ("--duration", "inf", "duration_s", "not-finite"),
        ("--duration", "0", "duration_s", "out-of-range"),
        ("--duration", "-1", "duration_s", "out-of-range"),
        ("--duration", "10s", "duration_s", "wrong-type"),
        ("--tick-hz", "0", "tick_hz", "out-of-range"),
        ("--tick-hz", "-5", "tick_hz", "out-of-range"),
        ("--tick-hz", "fast", "tick_hz", "wrong-type"),
    ] {
        assert_says(&refused(PAIR, &[option, value]), &format!("corotate: {option} {value}: {key}: "), code);
    }
    for role in ["nosuch", ""] {
        assert_says(&refused(PAIR, &["--external", role]), &format!("corotate: --external {role}: "), "unknown-role");
    }
    let alone = refused(PAIR, &["--external", "follower", "--clock", "in-process"]);
    assert_says(&alone, "corotate: --external follower: ", "one-process");
}

#[cfg(not(feature = "foxglove"))]
#[test]
fn foxglove_that_was_left_out_of_the_build_is_refused() {
    for arguments in [&["run", "--foxglove"][..], &["run", "--foxglove", "0.0.0.0:9000"], &["foxglove"]] {
        let done = refused_in(&Bench::new(), arguments);
        assert_eq!(done.codes(), ["built-without"]);
    }
}

#[cfg(not(feature = "parquet"))]
#[test]
fn parquet_that_was_left_out_of_the_build_is_refused() {
    let bench = Bench::new();
    for options in [&["--parquet", "tables"][..], &["--csv", "tables", "--parquet", "tables"]] {
        let done = refused_in(&bench, &[&["export", "nosuch.mcap"], options].concat());
        assert_eq!(done.codes(), ["built-without"]);
        assert!(!bench.path("tables").exists());
    }
}

#[test]
fn an_invalid_command_line_is_refused() {
    let bench = Bench::new();
    let path = bench.path("");
    let pair = shipped("rigid-pair").display().to_string();
    // A clap error names the word and points to the help.
    let words: [(&[&str], &str); 16] = [
        (&["nosuch"], "'nosuch'"),
        (&["--nosuch"], "'--nosuch'"),
        (&[""], "subcommand"),
        (&["run", "--nosuch"], "'--nosuch'"),
        (&["run", "a.toml", "b.toml"], "'b.toml'"),
        (&["run", "--set"], "'--set <KEY=VALUE>'"),
        (&["check"], "<SCENARIO>"),
        (&["seat"], "<SCENARIO>"),
        (&["seat", "nosuch.toml"], "<ROLE>"),
        (&["seat", &pair, "leader", "--clock", "in-process"], "[possible values: realtime, lockstep]"),
        (&["run", "--clock", "fast"], "[possible values: realtime, lockstep, in-process]"),
        (&["init"], "<NAME>"),
        (&["plant"], "--body <NAME>"),
        (&["plant", "--domain", "/nonexistent"], "--body <NAME>"),
        (&["export", "nosuch.mcap"], "<--csv <DIR>|--parquet <DIR>>"),
        (&["controller", "--domain", ""], "'--domain <DIR>'"),
    ];
    for (arguments, word) in words {
        let done = refused_in(&bench, arguments);
        assert!(done.stdout.is_empty() && done.stderr.contains(word) && done.stderr.contains("--help"), "{done:?}");
    }
    let cases: [(&[&str], &str, &str); 12] = [
        (&["run", "--external", "x"], "unknown-role", "leader"),
        (&["run", "--set", "tick_herz=1"], "unknown-key", "tick_hz"),
        (&["seat", "nosuch.toml", "leader"], "cannot-read-scenario", "nosuch.toml"),
        (&["seat", &pair, "nosuch"], "no-such-role", "leader, follower, observer, controller"),
        (&["seat", &pair, "leader", "--set", "clock=in-process"], "one-process", "--clock"),
        (&["seat", &pair, "leader", "--domain", "/nonexistent"], "not-a-domain", "/nonexistent"),
        (&["init", "nosuch"], "unknown-scenario", "rigid-pair"),
        (&["init", ""], "unknown-scenario", "rigid-pair"),
        (&["plant", "--domain", "/nonexistent", "--body", "leader"], "not-a-domain", "/nonexistent"),
        (&["observer", "--domain", "/nonexistent"], "not-a-domain", "/nonexistent"),
        (&["observer", "--domain", path.to_str().unwrap()], "not-a-domain", ""),
        (&["controller", "--domain", "."], "not-a-domain", ""),
    ];
    for (arguments, code, word) in cases {
        let done = refused_in(&bench, arguments);
        assert!(done.stdout.is_empty() && done.codes() == [code] && done.stderr.contains(word), "{done:?}");
    }
}

#[test]
fn check_prints_the_valid_files_beside_invalid_ones() {
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
fn check_prints_the_scenario_that_it_checked() {
    let bench = Bench::new();
    for (name, text) in SHIPPED {
        let path = shipped(name);
        let done = bench.run(&["check", "--resolved", path.to_str().unwrap()]);
        assert_eq!((done.code, done.stderr.as_str()), (Some(0), ""), "{name}");
        // The claims come first: here as comments, without the option alone.
        let claims: String =
            done.stdout.lines().map_while(|line| Some(format!("{}\n", line.strip_prefix("# ")?))).collect();
        assert_eq!(bench.run(&["check", path.to_str().unwrap()]).stdout, claims);
        assert!(claims.starts_with(&format!("{}: ", path.display())) && claims.lines().count() > 1, "{claims}");
        let resolved = Scenario::load(&path, &[]).unwrap().to_toml();
        assert_eq!(Scenario::parse(&done.stdout, name, &[]).unwrap().to_toml(), resolved);
        assert_eq!(Scenario::parse(&resolved, name, &[]).unwrap().to_toml(), resolved);
        // A file that the scenario names is built in under its own name.
        let beside = format!("{}/", path.parent().unwrap().display());
        let resolved = resolved.replace(&beside, "");
        assert_eq!(Scenario::parse(text, name, &[]).unwrap().to_toml(), resolved, "as built in");
    }
}

#[test]
fn a_full_stdout_is_an_error_and_not_a_panic() {
    let pair = shipped("rigid-pair");
    for arguments in [["init", "rigid-pair"], ["check", pair.to_str().unwrap()]] {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output = Bench::new().command().args(arguments).stdout(full).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert_eq!(stderr.lines().find_map(code_of), Some("cannot-print"), "{stderr}");
    }
}

/// Mistakes in the scenario's sections and in the rig's, each with its line.
#[test]
fn all_mistakes_are_reported_at_once_with_their_lines() {
    let bench = Bench::new();
    let mut text = PAIR.to_owned();
    let changes = [
        ("tick_hz", "tick_herz = 1000.0"),
        ("clock", "clock = \"fast\""),
        ("leader.inertia_kg_m2", "inertia = [1.0, 2.0, 2.5]"),
        ("follower[0].initial_rate_rad_s", "initial_rate_rad_s = [1.0, \"a\", 2.0]"),
        ("accept.settled_by_s", "settled_by_s = \"soon\""),
    ];
    let numbers = changes.map(|(key, line)| {
        let number = super::line_of(PAIR, key).unwrap();
        text = super::replace(&text, number, &[line]);
        (number, line)
    });
    std::fs::write(bench.path(FILE), &text).unwrap();
    let done = refused_in(&bench, &["run", FILE]);
    for (number, line) in numbers {
        let (at, quote) = (format!("corotate: {FILE}:{number}: "), format!("corotate: {number:>4} | {line}"));
        let lines: Vec<&str> = done.stderr.lines().collect();
        assert!(lines.windows(2).any(|pair| pair[0].starts_with(&at) && pair[1] == quote), "{at}: {done:?}");
    }
    // A misspelt key is not reported as missing too, and no mistake is reported twice.
    assert_eq!(done.stderr.lines().count(), 2 * changes.len(), "{done:?}");
    std::fs::write(bench.path(FILE), with(&with(PAIR, "rig", "\"rigidbody\""), "clock", "7")).unwrap();
    let done = refused_in(&bench, &["run", FILE]);
    assert!(done.codes() == ["wrong-type", "unknown-rig"] && done.stderr.contains("`rigid-body`"), "{done:?}");
}
