//! The command line: scenarios by name, the verdict line of a run, the newest run, help, colours, completions, manual pages and the
//! JSON schema.

use crate::common::{self, Bench, Done, WITHOUT_TICK_LIMITS, await_some, root, shipped, skipped};
use libc::SIGINT;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::Stdio;

/// A run that takes no time, of an open loop.
const RUN: [&str; 6] = ["run", "inertia", "--clock", "in-process", "--duration", "0.1"];
/// Removes the acceptance criteria.
const UNJUDGED: [&str; 2] = ["--set", "accept={}"];

/// Parses stdout, which must be a single line of JSON.
fn json_line(done: &Done) -> Value {
    assert_eq!(done.stdout.lines().count(), 1, "{done:?}");
    done.json()
}

/// Returns the commands that `help` lists.
fn commands(bench: &Bench) -> Vec<String> {
    let help = bench.run(&["help"]);
    let named = |line: &str| line.strip_prefix("  ")?.split_whitespace().next().map(str::to_owned);
    let rows: Vec<&str> = help.stdout.lines().skip_while(|line| !line.starts_with("  run ")).collect();
    let end = rows.iter().position(|line| line.is_empty()).unwrap();
    let (described, listed) = rows[..end].split_at(rows.iter().position(|line| line.starts_with("  and:")).unwrap());
    let words = |line: &&str| line.replace("and:", "").split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    described.iter().filter_map(|line| named(line)).chain(listed.iter().flat_map(words)).collect()
}

#[test]
fn help_fits_a_screen_and_lists_every_command() {
    let bench = Bench::new();
    let known = commands(&bench);
    for name in ["run", "check", "init", "seat", "plant", "record", "bench", "completions", "man"] {
        assert!(known.iter().any(|known| known == name), "{name} is not in {known:?}");
    }
    let mut helps = vec![vec!["--help"], vec!["-h"], vec!["help"]];
    helps.extend(known.iter().map(|name| vec![name.as_str(), "-h"]));
    for arguments in helps {
        let done = bench.run(&arguments);
        assert_eq!((done.code, done.stderr.as_str()), (Some(0), ""), "{arguments:?}");
        assert!(done.stdout.lines().count() <= 24, "{arguments:?} is too long:\n{}", done.stdout);
        assert!(done.stdout.lines().all(|line| line.chars().count() <= 80), "{arguments:?}:\n{}", done.stdout);
    }
    for name in &known {
        let long = bench.run(&[name, "--help"]).stdout;
        assert!(long.lines().all(|line| line.chars().count() <= 80), "{name}:\n{long}");
    }
    // The long form lists all options.
    let long = bench.run(&["run", "--help"]).stdout;
    assert!(
        ["--junit", "--require-rt", "--foxglove", "--color", "Examples:"].iter().all(|word| long.contains(word)),
        "{long}"
    );
    let clocks = "realtime, lockstep, in-process";
    assert!(long.contains(clocks), "{long}");
    let wrong = bench.run(&["run", "--clock", "fast"]);
    assert!(wrong.code == Some(2) && wrong.stderr.contains(clocks), "{wrong:?}");
    let misspelt = bench.run(&["chekc"]);
    assert!(misspelt.code == Some(2) && misspelt.stderr.contains("'check'"), "{misspelt:?}");
}

#[test]
fn version_lists_revision_features_and_platform() {
    let bench = Bench::new();
    let short = bench.run(&["-V"]).stdout;
    let long = bench.run(&["--version"]).stdout;
    assert!(long.starts_with(&short), "{long}");
    for name in ["revision  ", "features  ", "iceoryx2  0.10.0", "target    ", "host      "] {
        assert!(long.lines().any(|line| line.starts_with(name) && line.len() > 10), "{name}: {long}");
    }
    // The summary of a run has the same revision.
    let summary = bench.summary("inertia", &[&RUN[2..], &UNJUDGED].concat());
    let revision = summary["revision"].as_str().unwrap();
    assert!(long.contains(&format!("revision  {revision}\n")), "{long}");
    assert_eq!(short, format!("corotate {} ({revision})\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn a_name_is_a_shipped_scenario_and_a_path_is_a_file() {
    let bench = Bench::new();
    let named = bench.run(&["check", "inertia"]);
    assert_eq!((named.code, named.stderr.as_str()), (Some(0), ""));
    assert!(named.stdout.starts_with("inertia: "), "{}", named.stdout);
    // A file with the name of a shipped scenario is read only if it is given as a path.
    for name in ["inertia", "inertia.toml"] {
        fs::copy(shipped("inertia-axisymmetric"), bench.path(name)).unwrap();
    }
    let again = bench.run(&["check", "inertia"]);
    assert_eq!(again.stdout, named.stdout);
    for path in ["./inertia", "inertia.toml", bench.path("inertia").to_str().unwrap()] {
        let file = bench.run(&["check", "--resolved", path]);
        assert!(file.code == Some(0) && file.stdout.contains("\"inertia-axisymmetric\""), "{path}: {file:?}");
    }
    // All commands with a scenario take names.
    let run = bench.run(&[&RUN[..], &["--json"], &UNJUDGED].concat());
    assert_eq!((run.code, json_line(&run)["scenario"].as_str()), (Some(0), Some("inertia")));
    assert!(bench.run(&["seat", "inertia", "leader"]).stdout.contains("inertia"));
    let doctor = bench.run(&["doctor", "inertia", "--seconds", "0", "--json"]);
    assert_eq!(json_line(&doctor)["scenario"], "inertia");
    for command in
        [&["run", "rigid-tro"][..], &["check", "rigid-tro"], &["seat", "rigid-tro", "leader"], &["init", "rigid-tro"]]
    {
        let refused = bench.run(command);
        assert!(refused.code == Some(2) && refused.says("unknown-scenario"), "{refused:?}");
        assert!(["`rigid-tro`", "`rigid-trio`"].iter().all(|name| refused.stderr.contains(name)), "{refused:?}");
    }
}

#[test]
fn a_scenario_comes_from_standard_input() {
    let bench = Bench::new();
    let piped = |arguments: &[&str], text: &str| {
        let mut command = bench.command();
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code(), text(output.stdout), text(output.stderr))
    };
    let own = bench.run(&["init", "inertia"]).stdout;
    let (code, summary, _) = piped(&[&["run", "-", "--json"], &RUN[2..], &UNJUDGED].concat(), &own);
    assert_eq!(code, Some(0));
    assert!(summary.contains("\"scenario\":\"inertia\""), "{summary}");
    let (code, _, wrong) = piped(&["check", "-"], &own.replace("tick_hz", "tick_herz"));
    let line = 1 + own.lines().position(|line| line.starts_with("tick_hz")).unwrap();
    assert_eq!(code, Some(2));
    assert!(wrong.starts_with(&format!("corotate: stdin:{line}: tick_herz: ")), "{wrong}");
    assert!(wrong.contains("[unknown-key]"), "{wrong}");
    let (code, _, empty) = piped(&["run", "-"], "");
    assert!(code == Some(2) && empty.contains("stdin: name: ") && empty.contains("[missing-key]"), "{empty}");
}

#[test]
fn init_lists_shipped_scenarios_and_campaigns() {
    let bench = Bench::new();
    let list = bench.run(&["init", "--list"]).stdout;
    let listed = json_line(&bench.run(&["init", "--list", "--json"]));
    assert_eq!(listed["schema"], "corotate/scenarios/v1");
    let shipped = corotate::config::SHIPPED.into_iter().chain(corotate::campaign::SHIPPED);
    let entries = ["scenarios", "campaigns"].into_iter().flat_map(|kind| listed[kind].as_array().unwrap());
    assert_eq!((list.lines().count(), entries.clone().count()), (shipped.clone().count(), shipped.clone().count()));
    for ((line, (name, _)), entry) in list.lines().zip(shipped).zip(entries) {
        assert!(line.starts_with(&format!("{name} ")) && line.chars().count() <= 80, "{line}");
        assert_eq!(entry["name"], name);
        let title = entry["title"].as_str().unwrap();
        assert!(title.len() > 10 && line.ends_with(title), "{line}");
    }
}

#[test]
fn an_invalid_option_value_is_quoted_as_typed() {
    let bench = Bench::new();
    for (option, value, key, code) in [
        ("--duration", "-3", "duration_s", "out-of-range"),
        ("--tick-hz", "fast", "tick_hz", "wrong-type"),
        ("--duration", "", "duration_s", "no-value"),
    ] {
        let done = bench.run(&["run", option, value]);
        assert!(done.code == Some(2) && done.says(code), "{done:?}");
        assert!(done.stderr.starts_with(&format!("corotate: {option} {value}: {key}: ")), "{done:?}");
        assert!(!done.stderr.contains("--set"), "{done:?}");
    }
}

/// Counted without notes and privileges.
#[test]
fn the_table_of_a_run_fits_a_screen_unless_it_is_verbose() {
    let bench = Bench::new();
    for scenario in
        ["rigid-pair", "rigid-trio", "rigid-fleet", "orbit-hold", "orbit-rendezvous", "gyro-loss", "inertia"]
    {
        let run = ["run", scenario, "--duration", "1", "--set", "accept.settled_by_s=0.5"];
        let short = bench.run(&[&run[..], &["--out", &format!("{scenario}-short")]].concat());
        let table: Vec<&str> = short
            .stdout
            .lines()
            .filter(|line| !["note: ", "privileges: ", "  no "].iter().any(|more| line.starts_with(more)))
            .collect();
        assert!((8..=24).contains(&table.len()), "{short:?}");
        let wide = table.iter().filter(|line| line.chars().count() > 80 && !line.starts_with("FAIL: "));
        assert_eq!(wide.count(), 0, "{}", short.stdout);
        assert!(short.stdout.contains("observer") && !short.stdout.contains("baseline"), "{short:?}");
        let long = bench.run(&[&run[..], &["-v", "--out", &format!("{scenario}-long")]].concat());
        assert!(long.stdout.contains("baseline") && long.stdout.lines().count() > table.len(), "{long:?}");
    }
    bench.assert_clean(&[]);
}

/// The last line and the exit code of accepted runs, of one that is not accepted, and of one that is not judged.
#[test]
fn the_last_line_is_the_verdict() {
    let bench = Bench::new();
    let unmet = ["--set", "accept.coefficient_error_max=1e-30", "--set", "accept.settled_by_s=0"];
    let cases: [(&[&str], i32, &str); 4] = [
        (&RUN[..4], 0, "PASS: 4 criteria hold"),
        (&[&RUN[..], &unmet].concat(), 3, "FAIL: 1 of 4 criteria not met"),
        (&[&RUN[..], &UNJUDGED].concat(), 0, "NOT JUDGED: the scenario has no criteria"),
        (
            &[&RUN[..], &["--set", "accept={missed_ticks_max=0,step_latency_p99_us_max=1e6}"]].concat(),
            0,
            "PASS: 3 criteria hold, 1 not judged",
        ),
    ];
    for (arguments, code, last) in cases {
        let plain = bench.run(arguments);
        assert_eq!((plain.code, plain.stdout.lines().last()), (Some(code), Some(last)), "{plain:?}");
        assert!(plain.stdout.contains(" runs/"), "{plain:?}");
        let quiet = bench.run(&[arguments, &["-q"]].concat());
        assert_eq!((quiet.code, quiet.stdout.as_str()), (Some(code), &*format!("{last}\n")));
        assert_eq!(quiet.stderr.is_empty(), code == 0, "only errors: {quiet:?}");
        // A JSON object on stdout, everything else on stderr.
        let object = bench.run(&[arguments, &["--json"]].concat());
        assert_eq!((object.code, object.stderr.lines().last()), (Some(code), Some(last)), "{object:?}");
        let accepted = json_line(&object)["accepted"].as_bool();
        assert_eq!(
            accepted,
            [("PASS", Some(true)), ("FAIL", Some(false)), ("NOT ", None)]
                .iter()
                .find(|(word, _)| last.starts_with(word))
                .unwrap()
                .1
        );
        let quiet = bench.run(&[arguments, &["--json", "--quiet"]].concat());
        assert!(quiet.stderr.lines().last() == Some(last) && !quiet.stderr.contains(" runs/"), "{quiet:?}");
    }
    // A run that does not begin has no verdict.
    let refused = bench.run(&["run", "--set", "tick_hz=0"]);
    assert!(refused.stdout.is_empty() && refused.codes() == ["out-of-range"], "{refused:?}");
    assert!(!refused.stderr.contains("FAIL"), "{refused:?}");
}

#[test]
fn a_run_that_is_stopped_is_not_judged() {
    let bench = Bench::new();
    let run = ["run", "inertia", "--duration", "60", "--clock", "realtime", "--tick-hz", "200", "-v"];
    let run = bench.start(&[&run[..], &WITHOUT_TICK_LIMITS].concat());
    let domain = bench.await_domain();
    bench.await_role("observer");
    // Without a domain, `watch` and `record` take the newest run.
    let watched = bench.run(&["watch", "--once", "0.5"]);
    assert!(watched.code == Some(0) && watched.stdout.contains("inertia"), "{watched:?}");
    let recorder = bench.start(&["record", "--out", "part.mcap", "--json"]);
    await_some(|| fs::metadata(bench.path("part.mcap")).ok());
    std::thread::sleep(std::time::Duration::from_millis(500));
    recorder.signal(SIGINT);
    let recorded = recorder.wait().succeeded();
    assert_eq!(json_line(&recorded)["schema"], "corotate/record/v1");
    assert!(json_line(&recorded)["recording"]["messages"].as_u64().unwrap() > 0, "{recorded:?}");
    run.signal(SIGINT);
    let done = run.wait();
    // Missed ticks may follow.
    let last = done.stdout.lines().last().unwrap_or_default();
    assert!(done.code == Some(130) && last.starts_with("NOT JUDGED: stopped by signal 2"), "{done:?}");
    for word in [" runs/", " 12000", domain.to_str().unwrap()] {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    let refused = bench.run(&["record"]);
    assert!(refused.code == Some(2) && refused.says("no-run"), "{refused:?}");
}

/// Runs the program on a terminal and returns its output.
fn on_terminal(bench: &Bench, arguments: &[&str], variables: &[(&str, &str)]) -> String {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    let terminal = File::options().read(true).write(true).open(std::ffi::OsStr::from_bytes(name.to_bytes())).unwrap();
    let mut command = bench.command();
    command.args(arguments).env_remove("NO_COLOR").env("TERM", "xterm").envs(variables.iter().copied());
    let mut child = command.stdin(Stdio::null()).stdout(terminal).stderr(Stdio::null()).spawn().unwrap();
    drop(command);
    let mut text = Vec::new();
    // Reading fails once the program has closed its end of the terminal.
    let _ = File::from(master).read_to_end(&mut text);
    child.wait().unwrap();
    String::from_utf8(text).unwrap()
}

#[test]
fn colour_is_for_terminals_unless_chosen() {
    let bench = Bench::new();
    let run = [&RUN[..], &["-q"], &UNJUDGED].concat();
    let (plain, coloured) = ("NOT JUDGED: the", "\u{1b}[1;33mNOT JUDGED\u{1b}[0m: the");
    for (options, variables, expected) in [
        (&[][..], &[][..], coloured),
        (&["--color", "never"], &[], plain),
        (&[], &[("NO_COLOR", "1")], plain),
        (&[], &[("NO_COLOR", "")], coloured),
        (&[], &[("TERM", "dumb")], plain),
        (&["--color=always"], &[("NO_COLOR", "1")], coloured),
    ] {
        let text = on_terminal(&bench, &[&run, options].concat(), variables);
        assert!(text.starts_with(expected), "{options:?} {variables:?}: {text:?}");
    }
    let piped = bench.run(&run).stdout;
    assert!(piped.starts_with(plain), "{piped:?}");
    let piped = bench.run(&[&run[..], &["--color", "always"]].concat()).stdout;
    assert!(piped.starts_with(coloured), "{piped:?}");
    let wrong = bench.run(&["--color", "sometimes", "check", "rigid-pair"]);
    assert!(wrong.code == Some(2) && wrong.stderr.contains("auto, always, never"), "{wrong:?}");
    let help = on_terminal(&bench, &["--color", "never", "run", "--help"], &[]);
    assert!(!help.contains('\u{1b}'), "{help:?}");
}

#[test]
fn commands_take_the_newest_run() {
    let bench = Bench::new();
    for command in [&["report"][..], &["replay"], &["export", "--csv", "tables"], &["diff", "runs"]] {
        let refused = bench.run(command);
        assert!(refused.code == Some(2) && refused.stderr.lines().count() == 1, "{refused:?}");
    }
    assert!(bench.run(&["replay"]).says("no-latest-run"));
    let record = [&RUN[..], &["--record"], &UNJUDGED].concat();
    assert_eq!(bench.run(&record).code, Some(0));
    let first = fs::read_link(bench.path("runs/latest")).unwrap();
    assert!(first.to_str().unwrap().ends_with("-inertia") && first.components().count() == 1, "{first:?}");
    assert_eq!(bench.run(&[&record[..], &["--out", "runs/named", "--set", "seed=2"]].concat()).code, Some(0));
    assert_eq!(fs::read_link(bench.path("runs/latest")).unwrap(), Path::new("named"));
    // A run with results elsewhere, and one that does not begin, do not change the link.
    assert_eq!(bench.run(&[&record[..], &["--out", "elsewhere"]].concat()).code, Some(0));
    assert_eq!(bench.run(&["run", "--set", "tick_hz=0"]).code, Some(2));
    assert_eq!(fs::read_link(bench.path("runs/latest")).unwrap(), Path::new("named"));

    let report = json_line(&bench.run(&["report", "--json"]));
    assert_eq!((&report["schema"], &report["page"]), (&"corotate/report/v1".into(), &"runs/named/report.html".into()));
    assert!(bench.path("runs/named/report.html").exists());
    let over = bench.run(&["watch", "runs/named"]);
    assert!(over.code == Some(2) && over.says("run-over"), "{over:?}");
    let first = Path::new("runs").join(first);
    let (directory, file) = (first.to_str().unwrap(), first.join("run.mcap"));
    for arguments in
        [&["replay", "--json"][..], &["replay", directory, "--json"], &["replay", file.to_str().unwrap(), "--json"]]
    {
        let replay = json_line(&bench.run(arguments));
        assert_eq!((&replay["schema"], &replay["same"]), (&"corotate/replay/v1".into(), &true.into()), "{replay}");
        assert_eq!(replay["roles"].as_array().unwrap().len(), 2, "{replay}");
    }
    let diff = bench.run(&["diff", directory, "--json"]).succeeded();
    let diff = json_line(&diff);
    assert_eq!(
        (&diff["schema"], &diff["same"], &diff["b"]),
        (&"corotate/diff/v1".into(), &true.into(), &"runs/named/run.mcap".into())
    );
    assert!(diff["signals"].as_array().unwrap().iter().all(|signal| signal["compared_ticks"] == 101), "{diff}");
    assert_eq!(bench.run(&[&record[..], &["--set", "leader.initial_rate_rad_s=[1,2,3]"]].concat()).code, Some(0));
    let diff = bench.run(&["diff", directory, "--json"]);
    assert_eq!(diff.code, Some(3), "{diff:?}");
    let diff = json_line(&diff);
    let difference = &diff["signals"][0]["first"];
    assert!(diff["same"] == false && difference["a"].is_number() && difference["tick"] == 0, "{diff}");
    let export = bench.run(&["export", "--csv", "tables", "--json"]);
    let tables = json_line(&export)["tables"].as_array().unwrap().clone();
    assert!(
        !tables.is_empty() && tables.iter().all(|table| bench.path(table.as_str().unwrap()).exists()),
        "{export:?}"
    );

    // A run without a recording cannot be replayed.
    assert_eq!(bench.run(&[&RUN[..], &UNJUDGED].concat()).code, Some(0));
    let refused = bench.run(&["replay"]);
    assert!(refused.code == Some(2) && refused.says("no-recording"), "{refused:?}");
}

#[test]
fn a_foreign_runs_latest_is_neither_removed_nor_followed() {
    let bench = Bench::new();
    fs::create_dir_all(bench.path("runs/latest")).unwrap();
    fs::write(bench.path("runs/latest/notes"), "mine").unwrap();
    let run = [&RUN[..], &UNJUDGED].concat();
    let done = bench.run(&run).succeeded();
    assert!(done.stderr.contains("runs/latest"), "{done:?}");
    assert_eq!(fs::read_to_string(bench.path("runs/latest/notes")).unwrap(), "mine");
    let hidden = |entry: fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    assert!(!fs::read_dir(bench.path("runs")).unwrap().any(|entry| hidden(entry.unwrap())), "a temporary file is left");
    if !rustix::process::getuid().is_root() {
        return skipped("another user's runs/latest", "only root can make a link of another user");
    }
    // Another user's link is not followed; a run replaces it.
    fs::remove_dir_all(bench.path("runs/latest")).unwrap();
    fs::create_dir(bench.path("secret")).unwrap();
    std::os::unix::fs::symlink("../secret", bench.path("runs/latest")).unwrap();
    std::os::unix::fs::lchown(bench.path("runs/latest"), Some(65_534), None).unwrap();
    let refused = bench.run(&["report"]);
    assert!(refused.code == Some(2) && refused.says("cannot-read") && refused.stderr.contains("65534"), "{refused:?}");
    assert_eq!(bench.run(&run).code, Some(0));
    assert!(bench.run(&["report"]).code == Some(0) && bench.path("secret").read_dir().unwrap().count() == 0);
}

#[test]
fn open_shows_the_report_in_a_browser_if_there_is_one() {
    let bench = Bench::new();
    assert_eq!(bench.run(&[&RUN[..], &["-q"], &UNJUDGED].concat()).code, Some(0));
    let refused =
        common::Running::new(bench.command().args(["report", "--open"]).env("PATH", bench.path("bin"))).wait();
    assert!(refused.code == Some(1) && refused.says("no-browser"), "{refused:?}");
    fs::create_dir(bench.path("bin")).unwrap();
    let opener = bench.path("bin/xdg-open");
    let open = |script: &str| {
        fs::write(&opener, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&opener, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        common::Running::new(bench.command().args(["report", "--open"]).env("PATH", bench.path("bin"))).wait()
    };
    open("echo \"$1\" > opened").succeeded();
    let page = fs::read_to_string(bench.path("opened")).unwrap();
    assert!(page.starts_with('/') && page.trim_end().ends_with("report.html"), "{page}");
    assert_eq!(open("exit 3").code, Some(1));
}

/// Before it begins, in a single line with the command that grants them.
#[test]
fn a_realtime_run_reports_privileges_that_are_not_granted() {
    let bench = Bench::unprivileged();
    let program = bench.command().get_program().to_str().unwrap().to_owned();
    let run = |options: &str| {
        let script = format!(
            "ulimit -r 0 && ulimit -l 64 && exec {program} run inertia --duration 0.2 --set 'accept={{}}' {options}"
        );
        bench.start_program(Path::new("bash"), &["-c", &script]).wait()
    };
    let done = run("--clock realtime --set realtime.low_latency_idle=false").succeeded();
    let remedy = "`sudo prlimit --pid $$ --rtprio=99 --memlock=unlimited`";
    assert_eq!(done.codes(), ["not-granted"], "{done:?}");
    assert!(done.stderr.contains(remedy), "{done:?}");
    for options in [
        "--clock lockstep",
        "--clock realtime -q",
        "--clock realtime --set 'realtime={priority=0,lock_memory=false,low_latency_idle=false}'",
    ] {
        let done = run(options);
        assert_eq!((done.code, done.stderr.as_str()), (Some(0), ""), "{options}");
    }
}

#[test]
fn completions_work_for_every_shell() {
    let bench = Bench::new();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let done = bench.run(&["completions", shell]).succeeded();
        assert!(!done.stdout.contains("janitor") && !done.stdout.contains("bench-peer"), "{shell}");
        assert!(["run", "clock", "completions"].iter().all(|word| done.stdout.contains(word)), "{shell}");
    }
    fs::write(bench.path("corotate.bash"), bench.run(&["completions", "bash"]).stdout).unwrap();
    let script = "source corotate.bash && COMP_WORDS=(corotate run --clock in) COMP_CWORD=3 && \
                  _corotate corotate in --clock && echo ${COMPREPLY[@]}";
    let done = bench.start_program(Path::new("bash"), &["-c", script]).wait();
    assert!(done.stdout.contains("in-process"), "{done:?}");
    assert_eq!(bench.run(&["completions", "nosuch"]).code, Some(2));
}

#[test]
fn every_command_has_a_manual_page() {
    let bench = Bench::new();
    let done = bench.run(&["man", "pages/man1"]).succeeded();
    let known = commands(&bench);
    assert_eq!(done.stdout.lines().count(), 1 + known.len(), "{done:?}");
    for name in &known {
        let page = fs::read_to_string(bench.path(&format!("pages/man1/corotate-{name}.1"))).unwrap();
        assert!(page.contains(&format!("corotate\\-{name}")) && page.contains(".SH OPTIONS"), "{name}:\n{page}");
    }
    let run = fs::read_to_string(bench.path("pages/man1/corotate-run.1")).unwrap();
    assert!(
        run.contains(".SH NOTES\n.nf\n")
            && run.contains("rigid\\-trio")
            && run.contains("Possible values")
            && run.contains("JUnit"),
        "{run}"
    );
    let root = fs::read_to_string(bench.path("pages/man1/corotate.1")).unwrap();
    assert!(root.contains("128+n") && !root.contains("janitor") && !root.contains("host  "), "{root}");
    fs::write(bench.path("file"), "").unwrap();
    assert_eq!(bench.run(&["man", "file/below"]).code, Some(1));
}

/// All shipped scenarios are valid by the schema. Scenarios with one invalid key are refused by the program and by the schema, with an
/// independent validator.
#[test]
fn the_schema_accepts_shipped_scenarios_and_refuses_invalid_ones() {
    let bench = Bench::new();
    let schema = bench.run(&["schema"]);
    assert_eq!((schema.code, schema.stderr.as_str()), (Some(0), ""));
    fs::write(bench.path("schema.json"), &schema.stdout).unwrap();
    let pair = fs::read_to_string(shipped("rigid-pair")).unwrap();
    let mut files: Vec<(String, Option<&str>)> = Vec::new();
    for (name, text) in corotate::config::SHIPPED {
        // As shipped, and with every default filled in.
        let resolved = corotate::scenario::Scenario::parse(text, name, &[]).unwrap().to_toml();
        for (form, text) in [("shipped", text), ("resolved", &resolved)] {
            let file = format!("{name}-{form}.toml");
            fs::write(bench.path(&file), text).unwrap();
            files.push((file, None));
        }
    }
    for (number, (from, to, named)) in [
        ("tick_hz = ", "tick_herz = ", "tick_herz"),
        ("tick_hz = 1000.0", "tick_hz = \"fast\"", "tick_hz"),
        ("tick_hz = 1000.0", "", "'tick_hz' is a required property"),
        ("rig = \"rigid-body\"", "rig = \"rigidbody\"", "rig"),
        ("rig = \"rigid-body\"", "rig = \"orbit-hold\"", "observer"),
        ("clock = \"realtime\"", "clock = \"fast\"", "clock"),
        ("inertia_kg_m2 = ", "inertia = ", "leader"),
        ("inertia_kg_m2 = [1.0, 2.0, 2.5]", "inertia_kg_m2 = [1.0, 2.0]", "leader.inertia_kg_m2"),
        ("measured_axes = [1, 2]", "measured_axes = [1.5, 2]", "leader.measured_axes.0"),
        ("[[follower]]", "[follower]", "follower"),
        ("gain_per_s = ", "gian_per_s = ", "controller"),
        ("[accept]", "[accept]\nwrong = \"a\"", "accept.wrong"),
        ("[accept]", "[[fault]]\nkind = \"drip\"\nrole = \"leader\"\nfrom_tick = 1\n[accept]", "fault.0.kind"),
        ("[accept]", "[[fault]]\nkind = \"drop\"\nrole = \"leader\"\n[accept]", "'from_tick' is a required property"),
    ]
    .into_iter()
    .enumerate()
    {
        let (file, text) = (format!("wrong-{number}.toml"), pair.replacen(from, to, 1));
        assert_ne!(text, pair, "{from} is not there");
        fs::write(bench.path(&file), text).unwrap();
        assert_eq!(bench.run(&["check", &file]).code, Some(2), "{to} is refused by the program too");
        files.push((file, Some(named)));
    }
    let reader = root().join("tests/readers/schema.py");
    let mut command = bench.command_of(&common::python("readers"));
    command.arg(reader).arg("schema.json").args(files.iter().map(|(file, _)| file));
    let judged = common::Running::new(&mut command).wait();
    assert_eq!((judged.code, judged.stdout.lines().count()), (Some(0), files.len()), "{judged:?}");
    for ((file, named), line) in files.iter().zip(judged.stdout.lines()) {
        match named {
            None => assert_eq!(line, format!("{file}: valid")),
            Some(named) => {
                assert!(line.starts_with(&format!("{file}: invalid: ")) && line.contains(named), "{named}: {line}")
            }
        }
    }
}
