//! The command line: parse, validate, call the library, map errors to exit codes. No logic of its own.
//!
//! [`Program`] is the entry point for programs with rigs. One executable is launcher, roles and tools, because the launcher
//! starts roles from the program's own file.

// `--help` prints the comments on arguments: no Markdown.
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
mod perfetto;
mod record;
mod replay;
mod report;
mod role;
mod run;
mod runs;
mod scenario;
mod schema;
mod seat;
mod seat_header;
mod serve_seat;
mod set;
mod shipped;
mod signals;
mod step;
mod sweep;
mod tracer;
mod watch;
mod why;

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
    /// Colour the output; auto: on terminals, unless NO_COLOR is set
    #[arg(long, global = true, value_name = "WHEN", default_value = "auto", value_enum, hide_short_help = true)]
    color: When,
}

#[derive(Subcommand)]
enum Command {
    /// Run a scenario and print its verdict
    Run(Box<run::Arguments>),
    /// Run a campaign: many variants of one scenario, on all cores
    Sweep(sweep::Arguments),
    /// Validate scenarios and print the claims about their loops
    Check(check::Arguments),
    /// Print a commented scenario, or list all scenarios
    Init(init::Arguments),
    /// Create a crate with a rig of your own
    New(new::Arguments),
    /// Print, as JSON, what a program of your own needs to be a role
    Seat(seat::Arguments),
    /// Run one body of a run (normally started by the launcher)
    Plant(role::PlantArguments),
    /// Run an observer of a run (normally started by the launcher)
    Observer(role::ObserverArguments),
    /// Run the controller of a run (normally started by the launcher)
    Controller(role::Arguments),
    /// Connect a device on a serial line to a run, as a role
    Bridge(bridge::Arguments),
    /// Record every sample of a running loop to a file
    Record(record::Arguments),
    /// Feed a recording to the roles and compare bit for bit
    Replay(replay::Arguments),
    /// Compare two recordings
    Diff(diff::Arguments),
    /// Convert a recording to tables
    Export(export::Arguments),
    /// Write a report of a run, a recording or a campaign (HTML)
    Report(report::Arguments),
    /// Print the late ticks of a run with their causes
    Why(why::Arguments),
    /// Watch a running loop on the terminal
    Watch(watch::Arguments),
    /// Change gains, set points and disturbances of a running loop
    Set(set::SetArguments),
    /// Print the present values of what can change in a running loop
    Get(set::GetArguments),
    /// Serve a running loop to Foxglove (WebSocket)
    Foxglove(foxglove::Arguments),
    /// Join a run that another host launched
    Join(hosts::JoinArguments),
    /// Identify a body's inertia from logs of its angular velocity
    Identify(identify::Arguments),
    /// Estimate the rate about one axis from a log of the other two
    Estimate(Box<estimate::Arguments>),
    /// Check whether this machine is fit for real time
    Doctor(doctor::Arguments),
    /// Measure latencies and costs on this machine
    Bench(bench::Arguments),
    /// Print the JSON Schema of scenarios, for editors
    Schema(schema::Arguments),
    /// Print the completions of a shell
    Completions(help::CompletionsArguments),
    /// Write the manual pages to a directory
    Man(help::ManArguments),
    /// Exchange signals with the other hosts of a run
    #[command(hide = true)]
    Relay(hosts::RelayArguments),
    /// Step runs for the parent process
    #[command(hide = true)]
    Step,
    /// Serve a seat to the program that started this one
    #[command(hide = true)]
    ServeSeat(serve_seat::Arguments),
    /// Be the other end of a measured hop
    #[command(hide = true)]
    BenchPeer(bench::PeerArguments),
    /// Record the kernel's trace beside a run
    #[command(hide = true)]
    Tracer(tracer::Arguments),
    /// Remove what killed processes of a run leave behind
    #[command(hide = true)]
    Janitor(JanitorArguments),
}

/// Options of the janitor.
#[derive(clap::Args)]
struct JanitorArguments {
    /// The run's domain
    #[arg(long)]
    domain: PathBuf,
    /// The longest time that a process may take to create a file, s
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
    /// Creates a program without rigs.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a rig for scenarios.
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

    /// Adds a scenario that ships with the program. Commands accept its name wherever they take a scenario, and `init`
    /// prints it. Without a command the first one runs. `init --list` prints the first line of the text, a comment.
    #[must_use]
    pub fn scenario(mut self, name: &'static str, text: &'static str) -> Self {
        self.scenarios.push((name, text));
        self
    }

    /// Adds a campaign that ships with the program, as [`scenario`](Self::scenario) adds a scenario.
    #[must_use]
    pub fn campaign(mut self, name: &'static str, text: &'static str) -> Self {
        self.campaigns.push((name, text));
        self
    }

    /// Executes the command line and returns the exit code of the process.
    ///
    /// # Panics
    /// If a scenario was read before: rigs cannot be added after that.
    pub fn main(self) -> ExitCode {
        ExitCode::from(self.execute(std::env::args_os().collect()))
    }

    /// Executes the command line `words` and returns the exit code, for programs that are a library in an interpreter. The
    /// first word is the program's name. May end the process, for example after printing help.
    ///
    /// # Panics
    /// As [`main`](Self::main).
    pub fn execute(self, words: Vec<OsString>) -> u8 {
        let _ = WORDS.set(words);
        self.begin();
        let arguments =
            Arguments::from_arg_matches_mut(&mut help::line(Arguments::command()).get_matches_from(words_given()));
        let Arguments { command, color } = arguments.unwrap_or_else(|error| error.exit());
        color::choose(color);
        // A user's rig may panic, and so may iceoryx2 on unexpected system errors. The hook has printed the panic; unwinding
        // releases the resources of this process.
        let exit = std::panic::catch_unwind(|| execute(command)).unwrap_or(Exit::Failure);
        exit.code()
    }

    /// Measures rows like the command `bench`, with its options: the `main` of a bench target.
    ///
    /// # Panics
    /// If a scenario was read before: rigs cannot be added after that.
    pub fn bench(self, rows: &[Row]) -> ExitCode {
        self.begin();
        // `cargo bench` adds this word.
        let words = std::env::args().filter(|word| word != "--bench");
        ExitCode::from(bench::bench(&BenchArguments::parse_from(words).bench, rows).code())
    }

    fn begin(self) {
        assert!(register(self.rigs), "rigs must be registered before any scenario is read");
        let _ = SCENARIOS.set(self.scenarios);
        let _ = CAMPAIGNS.set(self.campaigns);
        // A file at its size limit is then an error of its writer, like a full disk; without this the signal kills the process.
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

/// Executes a command; without one, `run` with its defaults.
fn execute(command: Option<Command>) -> Exit {
    let result = match command {
        None => Ok(run::run(&run::Arguments::default())),
        Some(Command::Run(arguments)) => Ok(run::run(&arguments)),
        Some(Command::Sweep(arguments)) => sweep::sweep(&arguments),
        Some(Command::Check(arguments)) => check::check(&arguments),
        Some(Command::Init(arguments)) => init::init(&arguments),
        Some(Command::New(arguments)) => new::new(&arguments),
        Some(Command::Seat(arguments)) => seat::seat(&arguments),
        Some(Command::Plant(arguments)) => role::role(&arguments.body, &arguments.role),
        Some(Command::Observer(arguments)) => role::observer(&arguments),
        Some(Command::Controller(arguments)) => role::role("controller", &arguments),
        Some(Command::Bridge(arguments)) => bridge::bridge(&arguments),
        Some(Command::Record(arguments)) => record::record(&arguments),
        Some(Command::Replay(arguments)) => replay::replay(&arguments),
        Some(Command::Diff(arguments)) => diff::diff(&arguments),
        Some(Command::Export(arguments)) => export::export(&arguments),
        Some(Command::Report(arguments)) => report::report(&arguments),
        Some(Command::Why(arguments)) => why::why(&arguments),
        Some(Command::Watch(arguments)) => watch::watch(&arguments),
        Some(Command::Set(arguments)) => set::set(&arguments),
        Some(Command::Get(arguments)) => set::get(&arguments),
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
        Some(Command::Step) => step::step(),
        Some(Command::ServeSeat(arguments)) => serve_seat::serve(&arguments),
        Some(Command::BenchPeer(arguments)) => Ok(bench::peer(&arguments)),
        Some(Command::Tracer(arguments)) => tracer::tracer(&arguments),
        Some(Command::Janitor(arguments)) => Ok(janitor(&arguments)),
    };
    result.unwrap_or_else(|exit| exit)
}

fn janitor(arguments: &JanitorArguments) -> Exit {
    let limit = Duration::try_from_secs_f64(arguments.limit_s).map_err(|error| Failure::new("out-of-range", error));
    let domain = Domain::join(&arguments.domain).map_err(Failure::from);
    // Unbuffered: poll(2) does not see input in the buffer of a standard stream.
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
