//! Files, overrides, options and command lines that make no sense, and what `corotate check` prints beside them.

use super::{FILE, PAIR, assert_says, place, refused, refused_in, with};
use crate::common::{Bench, shipped};
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;

#[test]
fn what_is_no_file_is_refused() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("directory")).unwrap();
    std::fs::write(bench.path("file"), PAIR).unwrap();
    for command in ["run", "check"] {
        for (path, reason) in [
            ("nowhere.toml", "No such file"),
            ("./directory", "Is a directory"),
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
            // An empty text lacks every key that must be there.
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
        assert!(done.code == Some(2) && done.stderr.contains("no.mcap"), "{command:?}: {done:?}");
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
        ("--duration", "", "duration_s", ["neither TOML", "as a scenario does"]),
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
    let cases: [(&[&str], &str, &str); 28] = [
        (&["nosuch"], "unrecognized subcommand 'nosuch'", "--help"),
        (&["--nosuch"], "unexpected argument '--nosuch'", "--help"),
        (&[""], "unrecognized subcommand", "--help"),
        (&["run", "--nosuch"], "unexpected argument '--nosuch'", "--help"),
        (&["run", "a.toml", "b.toml"], "unexpected argument 'b.toml'", "--help"),
        (&["run", "--set"], "a value is required for '--set <KEY=VALUE>'", "--help"),
        (&["run", "--external", "x"], "no such role", "has: leader"),
        (&["run", "--set", "tick_herz=1"], "--set tick_herz=1", "did you mean"),
        (&["check"], "<SCENARIO>", "--help"),
        (&["seat"], "<SCENARIO>", "--help"),
        (&["seat", "nosuch.toml"], "<ROLE>", "--help"),
        (&["seat", "nosuch.toml", "leader"], "nosuch.toml: cannot be read", "give the path of a scenario file"),
        (&["seat", &pair, "nosuch"], "no role `nosuch`", "it has: leader, follower, observer, controller"),
        (
            &["seat", &pair, "leader", "--clock", "in-process"],
            "invalid value 'in-process'",
            "[possible values: realtime, lockstep]",
        ),
        (&["seat", &pair, "leader", "--set", "clock=in-process"], "no seats", "give --clock realtime or lockstep"),
        (&["run", "--clock", "fast"], "invalid value 'fast'", "[possible values: realtime, lockstep, in-process]"),
        (
            &["seat", &pair, "leader", "--domain", "/nonexistent"],
            "not the domain of a run",
            "the domains of your runs are in",
        ),
        (&["init"], "<NAME>", "--help"),
        (&["init", "nosuch"], "no scenario `nosuch`", "known here: rigid-pair"),
        (&["init", ""], "no scenario ``", "known here: rigid-pair"),
        (&["plant"], "--body <NAME>", "--help"),
        (&["plant", "--domain", "/nonexistent"], "--body <NAME>", "--help"),
        (
            &["plant", "--domain", "/nonexistent", "--body", "leader"],
            "not the domain of a run",
            "the domains of your runs are in",
        ),
        (&["observer", "--domain", "/nonexistent"], "not the domain of a run", "the domains of your runs are in"),
        (
            &["observer", "--domain", path.to_str().unwrap()],
            "not the domain of a run",
            "the domains of your runs are in",
        ),
        (&["export", "nosuch.mcap"], "<--csv <DIR>|--parquet <DIR>>", "--help"),
        (&["controller", "--domain", "."], "not the domain of a run", "the domains of your runs are in"),
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
        let done = bench.run(&["check", "--resolved", path.to_str().unwrap()]);
        assert_eq!((done.code, done.stderr.as_str()), (Some(0), ""), "{name}");
        // The claims come first: here as comments, without the option alone.
        let claims: String =
            done.stdout.lines().map_while(|line| Some(format!("{}\n", line.strip_prefix("# ")?))).collect();
        assert_eq!(bench.run(&["check", path.to_str().unwrap()]).stdout, claims);
        assert!(claims.contains("the loop that runs") || claims.contains("no body is driven"), "{claims}");
        let resolved = Scenario::load(&path, &[]).unwrap().to_toml();
        assert_eq!(Scenario::parse(&done.stdout, name, &[]).unwrap().to_toml(), resolved);
        assert_eq!(Scenario::parse(&resolved, name, &[]).unwrap().to_toml(), resolved);
        // A file that it names is built in under its name alone.
        let beside = format!("{}/", path.parent().unwrap().display());
        let resolved = resolved.replace(&beside, "");
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

/// Of the scenario's own sections and of the rig's, each with its line.
#[test]
fn all_mistakes_are_told_at_once_with_their_lines() {
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
        let told: Vec<&str> = done.stderr.lines().collect();
        assert!(told.windows(2).any(|pair| pair[0].starts_with(&at) && pair[1] == quote), "{at}: {done:?}");
    }
    // What is misspelt is not missing too, and nothing is told twice.
    assert_eq!(done.stderr.lines().count(), 2 * changes.len(), "{done:?}");
    std::fs::write(bench.path(FILE), with(&with(PAIR, "rig", "\"rigidbody\""), "clock", "7")).unwrap();
    let done = refused_in(&bench, &["run", FILE]);
    assert!(done.stderr.contains("did you mean `rigid-body`?") && done.stderr.contains(": clock: "), "{done:?}");
}
