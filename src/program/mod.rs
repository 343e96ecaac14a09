//! The command line: parse, validate, call the library, map errors to exit codes. No logic of its own.
//!
//! [`Program`] is the door for whoever has a rig: his `main` names it, and is launcher, roles and tools at once, because roles
//! are started from the program's own file.

// The comments on arguments are what `--help` prints: no Markdown.
#![allow(rustdoc::broken_intra_doc_links, rustdoc::invalid_html_tags)]

mod bench;
mod bridge;
mod campaign;
mod check;
mod color;
mod data;
mod diff;
mod doctor;
mod estimate;
mod export;
mod foxglove;
mod help;
mod hosts;
mod identify;
mod init;
mod new;
mod output;
mod record;
mod replay;
mod report;
mod role;
mod run;
mod runs;
mod scenario;
mod schema;
mod seat;
mod shipped;
mod signals;
mod sweep;
mod watch;

use crate::bench::Row;
use crate::bus::domain::Domain;
use crate::panics;
use crate::rig::Rig;
use crate::scenario::{RigKind, register};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use color::When;
use help::WIDTH;
use output::{Exit, Failure, fail, remark};
use shipped::{CAMPAIGNS, SCENARIOS, WORDS, words_given};
use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

/// Run a feedback control loop as separate processes; measure, test and replay it
#[derive(Parser)]
#[command(term_width = WIDTH)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// When to colour what is printed; NO_COLOR is heeded
    #[arg(long, global = true, value_name = "WHEN", default_value = "auto", value_enum, hide_short_help = true)]
    color: When,
}

#[derive(Subcommand)]
enum Command {
    /// Run a scenario to its end and tell how it went
    Run(run::Arguments),
    /// Run a campaign: one scenario many times, varied; on all cores
    Sweep(sweep::Arguments),
    /// Validate scenarios; print what may be claimed of their loops
    Check(check::Arguments),
    /// Print a commented scenario to start from, or list them
    Init(init::Arguments),
    /// Write a crate with a rig of your own to start from
    New(new::Arguments),
    /// Print what a program of your own needs to take a role's seat, as JSON
    Seat(seat::Arguments),
    /// Take the seat of a body in a run (the launcher starts it; so can you)
    Plant(role::PlantArguments),
    /// Take the observer's seat in a run
    Observer(role::Arguments),
    /// Take the controller's seat in a run
    Controller(role::Arguments),
    /// Put a device behind a serial line into a role's seat in a run
    Bridge(bridge::Arguments),
    /// Record every sample of a running loop to a file
    Record(record::Arguments),
    /// Feed a recording to the live roles, and compare bit for bit
    Replay(replay::Arguments),
    /// Compare two recordings
    Diff(diff::Arguments),
    /// Write a recording as tables
    Export(export::Arguments),
    /// Show a run, or a recording, as one page
    Report(report::Arguments),
    /// Watch a running loop on the terminal
    Watch(watch::Arguments),
    /// Show a running loop on a Foxglove WebSocket
    Foxglove(foxglove::Arguments),
    /// Take this host's part in a run that another host launched
    Join(hosts::JoinArguments),
    /// Find a body's inertia in a log of its angular velocity
    Identify(identify::Arguments),
    /// Find the rate about one axis in a log of the other two
    Estimate(Box<estimate::Arguments>),
    /// Tell whether this machine is fit for real time, and what to do
    Doctor(doctor::Arguments),
    /// Measure what everything costs beside its floors, on this machine
    Bench(bench::Arguments),
    /// Print a JSON Schema of scenarios, for editors
    Schema(schema::Arguments),
    /// Print the completions for a shell
    Completions(help::CompletionsArguments),
    /// Write the manual pages into a directory
    Man(help::ManArguments),
    /// Carry what crosses from this host of a run to others, and back
    #[command(hide = true)]
    Relay(hosts::RelayArguments),
    /// Take the other end of a hop that is measured
    #[command(hide = true)]
    BenchPeer(bench::PeerArguments),
    /// Clean up after processes of a run that were killed, and after its launcher
    #[command(hide = true)]
    Janitor(JanitorArguments),
}

/// Whom the launcher's janitor cleans up after.
#[derive(clap::Args)]
struct JanitorArguments {
    /// The run's domain
    #[arg(long)]
    domain: PathBuf,
    /// For how long somebody may stand still while he makes a file, s
    #[arg(long)]
    limit_s: f64,
}

/// A program that runs rigs: its launcher, its roles and its tools.
///
/// ```no_run
/// use corotate::Program;
/// use corotate::rig::RigidBodyRig;
/// use std::process::ExitCode;
///
/// fn main() -> ExitCode {
///     Program::new().rig::<RigidBodyRig>().main()
/// }
/// ```
#[derive(Default)]
pub struct Program {
    rigs: Vec<RigKind>,
    scenarios: Vec<(&'static str, &'static str)>,
    campaigns: Vec<(&'static str, &'static str)>,
}

impl Program {
    /// A program without rigs.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a rig: scenarios may name it.
    #[must_use]
    pub fn rig<R: Rig>(mut self) -> Self {
        self.rigs.push(RigKind::new::<R>());
        self
    }

    /// Adds rigs that another crate has compiled.
    #[must_use]
    pub fn rigs(mut self, kinds: impl IntoIterator<Item = RigKind>) -> Self {
        self.rigs.extend(kinds);
        self
    }

    /// Adds a scenario that ships with the program, by its name and its text: the name stands for it wherever a scenario is
    /// taken, `init` prints it, and the first one runs where none is named. The first line of the text, a comment, is what
    /// `init --list` says of it.
    #[must_use]
    pub fn scenario(mut self, name: &'static str, text: &'static str) -> Self {
        self.scenarios.push((name, text));
        self
    }

    /// Adds a campaign that ships with the program, by its name and its text, as [`scenario`](Self::scenario) does a scenario.
    #[must_use]
    pub fn campaign(mut self, name: &'static str, text: &'static str) -> Self {
        self.campaigns.push((name, text));
        self
    }

    /// Does what the command line asks for; the exit code is the process's.
    ///
    /// # Panics
    /// If a scenario was read before: the rigs are known from then on.
    pub fn main(self) -> ExitCode {
        ExitCode::from(self.obey(std::env::args_os().collect()))
    }

    /// The same for a program that is a library in an interpreter: does what these words ask for, the first of which is its name,
    /// and gives the exit code. It may end the process, as a program does that was asked for help.
    ///
    /// # Panics
    /// As [`main`](Self::main).
    pub fn obey(self, words: Vec<OsString>) -> u8 {
        let _ = WORDS.set(words);
        self.begin();
        let arguments =
            Arguments::from_arg_matches_mut(&mut help::line(Arguments::command()).get_matches_from(words_given()));
        let Arguments { command, color } = arguments.unwrap_or_else(|error| error.exit());
        color::choose(color);
        // A user's rig may panic, and iceoryx2 does where the system does what it holds impossible; the hook has told it. What
        // this process holds is put away on the way here.
        let exit = std::panic::catch_unwind(|| obey(command)).unwrap_or(Exit::Failure);
        exit.code()
    }

    /// Measures rows as the command `bench` does its own, with its options: the whole `main` of a bench target.
    ///
    /// # Panics
    /// If a scenario was read before: the rigs are known from then on.
    pub fn bench(self, rows: &[Row]) -> ExitCode {
        self.begin();
        // `cargo bench` adds a word of its own.
        let words = std::env::args().filter(|word| word != "--bench");
        ExitCode::from(bench::bench(&BenchArguments::parse_from(words).bench, rows).code())
    }

    fn begin(self) {
        assert!(register(self.rigs), "a program comes before any scenario is read");
        let _ = SCENARIOS.set(self.scenarios);
        let _ = CAMPAIGNS.set(self.campaigns);
        // A file that meets its size limit is an error like a full disk, told by whoever writes it; without this it is the end.
        let _ = signal_hook::flag::register(libc::SIGXFSZ, Arc::default());
        panics::set_hook(crate::FILE, remark);
    }
}

/// The command line of a bench target.
#[derive(Parser)]
struct BenchArguments {
    #[command(flatten)]
    bench: bench::Arguments,
}

/// Does what the command line asks for.
fn obey(command: Option<Command>) -> Exit {
    let ended = match command {
        None => Ok(run::run(&run::Arguments::default())),
        Some(Command::Run(arguments)) => Ok(run::run(&arguments)),
        Some(Command::Sweep(arguments)) => sweep::sweep(&arguments),
        Some(Command::Check(arguments)) => check::check(&arguments),
        Some(Command::Init(arguments)) => init::init(&arguments),
        Some(Command::New(arguments)) => new::new(&arguments),
        Some(Command::Seat(arguments)) => seat::seat(&arguments),
        Some(Command::Plant(arguments)) => role::role(&arguments.body, &arguments.seat),
        Some(Command::Observer(arguments)) => role::role("observer", &arguments),
        Some(Command::Controller(arguments)) => role::role("controller", &arguments),
        Some(Command::Bridge(arguments)) => bridge::bridge(&arguments),
        Some(Command::Record(arguments)) => record::record(&arguments),
        Some(Command::Replay(arguments)) => replay::replay(&arguments),
        Some(Command::Diff(arguments)) => diff::diff(&arguments),
        Some(Command::Export(arguments)) => export::export(&arguments),
        Some(Command::Report(arguments)) => report::report(&arguments),
        Some(Command::Watch(arguments)) => watch::watch(&arguments),
        Some(Command::Foxglove(arguments)) => foxglove::foxglove(&arguments),
        Some(Command::Join(arguments)) => hosts::join(&arguments),
        Some(Command::Relay(arguments)) => hosts::relay(&arguments),
        Some(Command::Identify(arguments)) => identify::identify(&arguments),
        Some(Command::Estimate(arguments)) => estimate::estimate(&arguments),
        Some(Command::Doctor(arguments)) => doctor::doctor(&arguments),
        Some(Command::Bench(arguments)) => Ok(bench::bench(&arguments, crate::bench::ROWS)),
        Some(Command::Schema(arguments)) => schema::schema(&arguments),
        Some(Command::Completions(arguments)) => help::completions(&arguments, Arguments::command()),
        Some(Command::Man(arguments)) => help::man(&arguments, Arguments::command()),
        Some(Command::BenchPeer(arguments)) => Ok(bench::peer(&arguments)),
        Some(Command::Janitor(arguments)) => Ok(janitor(&arguments)),
    };
    ended.unwrap_or_else(|exit| exit)
}

fn janitor(arguments: &JanitorArguments) -> Exit {
    let limit = Duration::try_from_secs_f64(arguments.limit_s).map_err(|error| Failure::new("out-of-range", error));
    let domain = Domain::join(&arguments.domain).map_err(Failure::from);
    // Without the buffers of the standard streams: what is in one is not seen by whoever waits for input.
    let line = io::stdin().as_fd().try_clone_to_owned().map(File::from);
    let line = line.map_err(|error| Failure::new("no-standard-input", error));
    match (limit, domain, line) {
        (Ok(limit), Ok(domain), Ok(line)) => match crate::launch::janitor(&domain, limit, line, io::stdout()) {
            Ok(()) => Exit::Ok,
            Err(error) => fail(Exit::Failure, Failure::new("janitor-failed", error)),
        },
        (Err(error), ..) | (_, Err(error), _) | (.., Err(error)) => fail(Exit::Usage, error),
    }
}
