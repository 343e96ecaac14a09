//! The command line: scenarios by name, the last line of a run, the newest run, help that fits a screen, what is for shells and
//! programs.

use crate::common::{self, Bench, Done, WITHOUT_TICK_LIMITS, await_some, root, shipped, skipped};
use libc::SIGINT;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::Stdio;

/// A run that takes no time: of a loop that is not closed, of which nothing need be claimed.
const RUN: [&str; 6] = ["run", "inertia", "--clock", "in-process", "--duration", "0.1"];
/// Nothing to judge.
const UNJUDGED: [&str; 2] = ["--set", "accept={}"];

/// The one line of JSON that a command prints.
fn one_line(done: &Done) -> Value {
    assert_eq!(done.stdout.lines().count(), 1, "{done:?}");
    done.json()
}

/// The commands that help tells of.
fn commands(bench: &Bench) -> Vec<String> {
    let help = bench.run(&["help"]);
    let named = |line: &str| line.strip_prefix("  ")?.split_whitespace().next().map(str::to_owned);
    let rows: Vec<&str> = help.stdout.lines().skip_while(|line| !line.starts_with("  run ")).collect();
    let end = rows.iter().position(|line| line.is_empty()).unwrap();
    let others = rows[..end].iter().position(|line| line.starts_with("  and:")).unwrap();
    let others_of = |line: &&str| line.replace("and:", "").split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    rows[..others].iter().filter_map(|line| named(line)).chain(rows[others..end].iter().flat_map(others_of)).collect()
}

#[test]
fn help_fits_a_screen_and_tells_of_every_command() {
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
    // The long form has everything.
    let long = bench.run(&["run", "--help"]).stdout;
    assert!(
        ["--junit", "--require-rt", "--foxglove", "--color", "Examples:"].iter().all(|word| long.contains(word)),
        "{long}"
    );
    assert!(long.contains("[possible values: realtime, lockstep, in-process]"), "{long}");
    let wrong = bench.run(&["run", "--clock", "fast"]);
    assert!(
        wrong.code == Some(2) && wrong.stderr.contains("[possible values: realtime, lockstep, in-process]"),
        "{wrong:?}"
    );
    let misspelt = bench.run(&["chekc"]);
    assert!(misspelt.code == Some(2) && misspelt.stderr.contains("'check'"), "{misspelt:?}");
}

#[test]
fn the_version_says_what_the_program_is_made_of() {
    let bench = Bench::new();
    let short = bench.run(&["-V"]).stdout;
    assert_eq!(short, format!("corotate {}\n", env!("CARGO_PKG_VERSION")));
    let long = bench.run(&["--version"]).stdout;
    assert!(long.starts_with(&short), "{long}");
    for name in ["revision  ", "features  ", "iceoryx2  0.10.0", "target    ", "host      "] {
        assert!(long.lines().any(|line| line.starts_with(name) && line.len() > 10), "{name}: {long}");
    }
    // What a run notes of itself is the same.
    let summary = bench.summary("inertia", &[&RUN[2..], &UNJUDGED].concat());
    assert!(long.contains(&format!("revision  {}\n", summary["revision"].as_str().unwrap())), "{long}");
}

#[test]
fn a_name_is_a_shipped_scenario_and_a_path_is_a_file() {
    let bench = Bench::new();
    let named = bench.run(&["check", "inertia"]);
    assert_eq!((named.code, named.stderr.as_str()), (Some(0), ""));
    assert!(named.stdout.starts_with("inertia: valid\n"), "{}", named.stdout);
    // A file of that name means nothing, unless it is given as a path.
    for name in ["inertia", "inertia.toml"] {
        fs::copy(shipped("inertia-axisymmetric"), bench.path(name)).unwrap();
    }
    let again = bench.run(&["check", "inertia"]);
    assert_eq!(again.stdout, named.stdout);
    for path in ["./inertia", "inertia.toml", bench.path("inertia").to_str().unwrap()] {
        let file = bench.run(&["check", "--resolved", path]);
        assert!(file.code == Some(0) && file.stdout.contains("name = \"inertia-axisymmetric\""), "{path}: {file:?}");
    }
    // Wherever a scenario is taken.
    let run = bench.run(&[&RUN[..], &["--json"], &UNJUDGED].concat());
    assert_eq!((run.code, one_line(&run)["scenario"].as_str()), (Some(0), Some("inertia")));
    assert!(bench.run(&["seat", "inertia", "leader"]).stdout.contains("inertia"));
    let doctor = bench.run(&["doctor", "inertia", "--seconds", "0", "--json"]);
    assert_eq!(one_line(&doctor)["scenario"], "inertia");
    for command in
        [&["run", "rigid-tro"][..], &["check", "rigid-tro"], &["seat", "rigid-tro", "leader"], &["init", "rigid-tro"]]
    {
        let refused = bench.run(command);
        let words = "corotate: there is no scenario `rigid-tro`; did you mean `rigid-trio`?";
        assert!(refused.code == Some(2) && refused.stderr.starts_with(words), "{refused:?}");
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
    assert!(wrong.starts_with(&format!("corotate: stdin:{line}: tick_herz: unknown key")), "{wrong}");
    let (code, _, empty) = piped(&["run", "-"], "");
    assert!(code == Some(2) && empty.contains("stdin: name: is missing"), "{empty}");
}

#[test]
fn init_lists_what_ships() {
    let bench = Bench::new();
    let list = bench.run(&["init", "--list"]).stdout;
    let told = one_line(&bench.run(&["init", "--list", "--json"]));
    assert_eq!(told["schema"], "corotate/scenarios/v1");
    let shipped = corotate::config::SHIPPED.into_iter().chain(corotate::campaign::SHIPPED);
    let entries = ["scenarios", "campaigns"].into_iter().flat_map(|kind| told[kind].as_array().unwrap());
    assert_eq!((list.lines().count(), entries.clone().count()), (shipped.clone().count(), shipped.clone().count()));
    for ((line, (name, _)), entry) in list.lines().zip(shipped).zip(entries) {
        assert!(line.starts_with(&format!("{name} ")) && line.chars().count() <= 80, "{line}");
        assert_eq!(entry["name"], name);
        let title = entry["title"].as_str().unwrap();
        assert!(title.len() > 10 && line.ends_with(title), "{line}");
    }
}

#[test]
fn an_option_that_makes_no_sense_is_named_as_it_was_typed() {
    let bench = Bench::new();
    for (option, value, key) in
        [("--duration", "-3", "duration_s"), ("--tick-hz", "fast", "tick_hz"), ("--duration", "", "duration_s")]
    {
        let done = bench.run(&["run", option, value]);
        let words = format!("corotate: {option} {value}: {key}: ");
        assert!(done.code == Some(2) && done.stderr.starts_with(&words), "{done:?}");
        assert!(!done.stderr.contains("--set duration"), "{done:?}");
    }
}

/// Notes and privileges that are not granted come on top.
#[test]
fn the_table_of_a_run_fits_on_a_screen_and_all_of_it_is_behind_an_option() {
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
        assert!(short.stdout.contains("observer step") && !short.stdout.contains("baseline"), "{short:?}");
        let long = bench.run(&[&run[..], &["-v", "--out", &format!("{scenario}-long")]].concat());
        assert!(long.stdout.contains("baseline") && long.stdout.lines().count() > table.len(), "{long:?}");
    }
    bench.assert_clean(&[]);
}

/// Of a run that was judged well, of one that was not, and of one that was not judged: in its last line, by its exit code.
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
        assert!(plain.stdout.contains("results in runs/"), "{plain:?}");
        let quiet = bench.run(&[arguments, &["-q"]].concat());
        assert_eq!((quiet.code, quiet.stdout.as_str()), (Some(code), &*format!("{last}\n")));
        assert_eq!(quiet.stderr.is_empty(), code == 0, "nothing but errors: {quiet:?}");
        // One object on stdout, everything else on stderr.
        let object = bench.run(&[arguments, &["--json"]].concat());
        assert_eq!((object.code, object.stderr.lines().last()), (Some(code), Some(last)), "{object:?}");
        let accepted = one_line(&object)["accepted"].as_bool();
        assert_eq!(
            accepted,
            [("PASS", Some(true)), ("FAIL", Some(false)), ("NOT ", None)]
                .iter()
                .find(|(word, _)| last.starts_with(word))
                .unwrap()
                .1
        );
        let quiet = bench.run(&[arguments, &["--json", "--quiet"]].concat());
        assert!(quiet.stderr.lines().last() == Some(last) && !quiet.stderr.contains("results in"), "{quiet:?}");
    }
    // What did not begin is not judged, and says why.
    let none = bench.run(&["run", "--set", "tick_hz=0"]);
    assert!(none.stdout.is_empty() && !none.stderr.contains("FAIL"), "{none:?}");
}

#[test]
fn a_run_that_is_stopped_is_not_judged() {
    let bench = Bench::new();
    let run = ["run", "inertia", "--duration", "60", "--clock", "realtime", "--tick-hz", "200", "-v"];
    let run = bench.start(&[&run[..], &WITHOUT_TICK_LIMITS].concat());
    let domain = await_some(|| bench.domains().pop());
    bench.await_role("observer");
    // The newest run is what record takes where no domain is named, and what watch does.
    let watched = bench.run(&["watch", "--once", "0.5"]);
    assert!(watched.code == Some(0) && watched.stdout.contains("inertia"), "{watched:?}");
    let recorder = bench.start(&["record", "--out", "part.mcap", "--json"]);
    await_some(|| fs::metadata(bench.path("part.mcap")).ok());
    std::thread::sleep(std::time::Duration::from_millis(500));
    recorder.signal(SIGINT);
    let recorded = recorder.wait().succeeded();
    assert_eq!(one_line(&recorded)["schema"], "corotate/record/v1");
    assert!(one_line(&recorded)["recording"]["messages"].as_u64().unwrap() > 0, "{recorded:?}");
    run.signal(SIGINT);
    let done = run.wait();
    // Ticks that were missed by then are named, too.
    let last = done.stdout.lines().last().unwrap_or_default();
    assert!(done.code == Some(130) && last.starts_with("NOT JUDGED: stopped by signal 2"), "{done:?}");
    for words in ["results go to runs/", "the run's domain is ", "running ticks 0 to 12000"] {
        assert!(done.stderr.contains(words), "{words}: {done:?}");
    }
    assert!(done.stderr.contains(domain.to_str().unwrap()), "{done:?}");
    let none = bench.run(&["record"]);
    assert!(none.code == Some(2) && none.says("no-run"), "{none:?}");
}

/// A terminal that the program writes to: what came there.
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
    // A terminal that nobody has open any more is an error to whoever reads its other end.
    let _ = File::from(master).read_to_end(&mut text);
    child.wait().unwrap();
    String::from_utf8(text).unwrap()
}

#[test]
fn colour_is_for_terminals_and_for_who_wants_it() {
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
    assert!(wrong.code == Some(2) && wrong.stderr.contains("[possible values: auto, always, never]"), "{wrong:?}");
    let help = on_terminal(&bench, &["--color", "never", "run", "--help"], &[]);
    assert!(!help.contains('\u{1b}'), "{help:?}");
}

#[test]
fn the_newest_run_is_what_commands_take() {
    let bench = Bench::new();
    for command in [&["report"][..], &["replay"], &["export", "--csv", "tables"], &["diff", "runs"]] {
        let none = bench.run(command);
        assert!(none.code == Some(2) && none.stderr.lines().count() == 1, "{none:?}");
    }
    assert!(bench.run(&["replay"]).says("no-latest-run"));
    let record = [&RUN[..], &["--record"], &UNJUDGED].concat();
    assert_eq!(bench.run(&record).code, Some(0));
    let first = fs::read_link(bench.path("runs/latest")).unwrap();
    assert!(first.to_str().unwrap().ends_with("-inertia") && first.components().count() == 1, "{first:?}");
    assert_eq!(bench.run(&[&record[..], &["--out", "runs/named", "--set", "seed=2"]].concat()).code, Some(0));
    assert_eq!(fs::read_link(bench.path("runs/latest")).unwrap(), Path::new("named"));
    // A run elsewhere, and one that could not begin, leave it alone.
    assert_eq!(bench.run(&[&record[..], &["--out", "elsewhere"]].concat()).code, Some(0));
    assert_eq!(bench.run(&["run", "--set", "tick_hz=0"]).code, Some(2));
    assert_eq!(fs::read_link(bench.path("runs/latest")).unwrap(), Path::new("named"));

    let report = one_line(&bench.run(&["report", "--json"]));
    assert_eq!((&report["schema"], &report["page"]), (&"corotate/report/v1".into(), &"runs/named/report.html".into()));
    assert!(bench.path("runs/named/report.html").exists());
    let over = bench.run(&["watch", "runs/named"]);
    assert!(over.code == Some(2) && over.says("run-over"), "{over:?}");
    let first = Path::new("runs").join(first);
    let (directory, file) = (first.to_str().unwrap(), first.join("run.mcap"));
    for arguments in
        [&["replay", "--json"][..], &["replay", directory, "--json"], &["replay", file.to_str().unwrap(), "--json"]]
    {
        let replay = one_line(&bench.run(arguments));
        assert_eq!((&replay["schema"], &replay["same"]), (&"corotate/replay/v1".into(), &true.into()), "{replay}");
        assert_eq!(replay["roles"].as_array().unwrap().len(), 2, "{replay}");
    }
    let diff = bench.run(&["diff", directory, "--json"]).succeeded();
    let diff = one_line(&diff);
    assert_eq!(
        (&diff["schema"], &diff["same"], &diff["b"]),
        (&"corotate/diff/v1".into(), &true.into(), &"runs/named/run.mcap".into())
    );
    assert!(diff["signals"].as_array().unwrap().iter().all(|signal| signal["compared_ticks"] == 101), "{diff}");
    assert_eq!(bench.run(&[&record[..], &["--set", "leader.initial_rate_rad_s=[1,2,3]"]].concat()).code, Some(0));
    let other = bench.run(&["diff", directory, "--json"]);
    assert_eq!(other.code, Some(3), "{other:?}");
    let first_of = &one_line(&other)["signals"][0]["first"];
    assert!(one_line(&other)["same"] == false && first_of["a"].is_number() && first_of["tick"] == 0, "{other:?}");
    let export = bench.run(&["export", "--csv", "tables", "--json"]);
    let tables = one_line(&export)["tables"].as_array().unwrap().clone();
    assert!(
        !tables.is_empty() && tables.iter().all(|table| bench.path(table.as_str().unwrap()).exists()),
        "{export:?}"
    );

    // A run without samples has no recording to take.
    assert_eq!(bench.run(&[&RUN[..], &UNJUDGED].concat()).code, Some(0));
    let none = bench.run(&["replay"]);
    assert!(none.code == Some(2) && none.stderr.contains("run.mcap"), "{none:?}");
}

#[test]
fn what_is_no_link_of_ours_is_left_alone() {
    let bench = Bench::new();
    fs::create_dir_all(bench.path("runs/latest")).unwrap();
    fs::write(bench.path("runs/latest/notes"), "mine").unwrap();
    let run = [&RUN[..], &UNJUDGED].concat();
    let done = bench.run(&run).succeeded();
    assert!(
        done.stderr.contains("runs/latest does not lead to this run: latest is there and is not a link"),
        "{done:?}"
    );
    assert_eq!(fs::read_to_string(bench.path("runs/latest/notes")).unwrap(), "mine");
    let left = |entry: fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    assert!(!fs::read_dir(bench.path("runs")).unwrap().any(|entry| left(entry.unwrap())), "something is left");
    if !rustix::process::getuid().is_root() {
        return skipped("another user's runs/latest", "only root can make a link of another user");
    }
    // Another user's link is not followed, and is replaced.
    fs::remove_dir_all(bench.path("runs/latest")).unwrap();
    fs::create_dir(bench.path("secret")).unwrap();
    std::os::unix::fs::symlink("../secret", bench.path("runs/latest")).unwrap();
    std::os::unix::fs::lchown(bench.path("runs/latest"), Some(65_534), None).unwrap();
    let refused = bench.run(&["report"]);
    assert!(refused.code == Some(2) && refused.stderr.contains("is not followed"), "{refused:?}");
    assert_eq!(bench.run(&run).code, Some(0));
    assert!(bench.run(&["report"]).code == Some(0) && bench.path("secret").read_dir().unwrap().count() == 0);
}

#[test]
fn a_page_is_opened_where_there_is_something_to_open_it_with() {
    let bench = Bench::new();
    assert_eq!(bench.run(&[&RUN[..], &["-q"], &UNJUDGED].concat()).code, Some(0));
    let none = common::Running::new(bench.command().args(["report", "--open"]).env("PATH", bench.path("bin"))).wait();
    assert!(none.code == Some(1) && none.says("no-browser"), "{none:?}");
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

/// Before it begins, in one line, and with one command that changes it.
#[test]
fn a_run_in_real_time_tells_what_is_not_granted() {
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
    assert!(done.stderr.lines().count() == 1 && done.codes() == ["not-granted"], "{done:?}");
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
fn completions_are_for_every_shell_and_complete_what_there_is() {
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

/// Every scenario that the program takes is valid by its schema, and what it refuses of one key alone is not; the judge is a
/// validator that knows nothing of corotate.
#[test]
fn the_schema_holds_of_every_shipped_scenario_and_of_no_wrong_one() {
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
    for (number, (from, to, told)) in [
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
        files.push((file, Some(told)));
    }
    let reader = root().join("tests/readers/schema.py");
    let mut command = bench.command_of(&common::python("readers"));
    command.arg(reader).arg("schema.json").args(files.iter().map(|(file, _)| file));
    let judged = common::Running::new(&mut command).wait();
    assert_eq!((judged.code, judged.stdout.lines().count()), (Some(0), files.len()), "{judged:?}");
    for ((file, told), line) in files.iter().zip(judged.stdout.lines()) {
        match told {
            None => assert_eq!(line, format!("{file}: valid")),
            Some(told) => {
                assert!(line.starts_with(&format!("{file}: invalid: ")) && line.contains(told), "{told}: {line}")
            }
        }
    }
}
