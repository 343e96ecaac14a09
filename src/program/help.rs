//! The command line as it describes itself: help that fits a screen, the version, completions, manual pages.
//!
//! Must not describe a command twice: everything is made of the definition by which the command line is read.

use super::color::When;
use super::output::{Ended, Exit, Failure, fail, say};
use super::shipped::{name, scenarios, words_given};
use crate::bus::iox;
use crate::files;
use crate::telemetry::MachineInfo;
use clap::{ColorChoice, ValueEnum};
use clap_complete::Shell;
use std::fmt::Write;
use std::io;
use std::path::{Path, PathBuf};

/// How wide help may be: every terminal has so much.
pub const WIDTH: usize = 80;
/// The commands that a user meets first, which help explains in a line each.
const FIRST: [&str; 10] = ["run", "check", "init", "new", "report", "watch", "replay", "diff", "export", "doctor"];
const TEMPLATE: &str = "{about}\n\n{usage-heading} {usage}{after-help}";
const OPTIONS: &str = "\
`COMMAND --help` explains a command, with examples; `COMMAND -h` in brief.
-V prints the version, --version more. --color auto|always|never is for all.
Exit codes: 0 ok, 1 failure, 2 usage or configuration, 3 not accepted, or not
the same, 4 a process died, 5 a privilege not granted, 128+n ended by signal n";

/// Options of `corotate completions`.
#[derive(clap::Args)]
#[command(after_long_help = COMPLETIONS)]
pub struct CompletionsArguments {
    /// The shell
    shell: Shell,
}

const COMPLETIONS: &str = "\
Examples:
  cd ~/.local/share/bash-completion/completions
  corotate completions bash > corotate
  corotate completions fish > ~/.config/fish/completions/corotate.fish
  corotate completions zsh > ~/.zfunc/_corotate    with ~/.zfunc in $fpath";

/// Options of `corotate man`.
#[derive(clap::Args)]
#[command(after_long_help = MAN)]
pub struct ManArguments {
    /// Where to write corotate.1 and a page for each command
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

const MAN: &str = "\
Example:
  corotate man ~/.local/share/man/man1 && man corotate-run";

/// Returns the definition of the command line with its help, as it is read.
pub fn line(definition: clap::Command) -> clap::Command {
    let line = named(definition);
    let version = format!("{}\n{}", version(), about_build());
    let overview = overview(&line) + OPTIONS;
    // For the rest of the process, which reads its command line once.
    line.long_version(&*version.leak()).help_template(TEMPLATE).after_help(overview).color(asked_color())
}

/// Returns the definition with the program's name and version: what of it is the same on every machine.
fn named(definition: clap::Command) -> clap::Command {
    definition.name(name()).version(version())
}

fn version() -> &'static str {
    let (own, with) = (env!("CARGO_PKG_VERSION"), concat!("with corotate ", env!("CARGO_PKG_VERSION")));
    if name() == env!("CARGO_PKG_NAME") { own } else { with }
}

/// What `--color` asks for. Help is printed while the line is read, so it cannot wait for the result.
fn asked_color() -> ColorChoice {
    let words: Vec<String> = words_given().iter().map(|word| word.to_string_lossy().into_owned()).collect();
    let beside = words.windows(2).find(|pair| pair[0] == "--color").map(|pair| pair[1].as_str());
    let within = || words.iter().find_map(|word| word.strip_prefix("--color="));
    match beside.or_else(within).and_then(|word| When::from_str(word, false).ok()) {
        Some(When::Always) => ColorChoice::Always,
        Some(When::Never) => ColorChoice::Never,
        Some(When::Auto) | None => ColorChoice::Auto,
    }
}

/// The commands: what each does, or where there are more than a screen takes, their names.
fn overview(line: &clap::Command) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let visible = || line.get_subcommands().filter(|command| !command.is_hide_set());
    for command in FIRST.iter().filter_map(|first| visible().find(|command| command.get_name() == *first)) {
        let about = command.get_about().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(text, "  {:<9}{about}", command.get_name());
    }
    let others = visible().map(clap::Command::get_name).filter(|name| !FIRST.contains(name));
    let mut column = 0;
    for name in others {
        if column == 0 || column + name.len() + 1 > WIDTH {
            let _ = write!(text, "{}", if column == 0 { "  and: " } else { "\n      " });
            column = 6;
        }
        let _ = write!(text, " {name}");
        column += name.len() + 1;
    }
    let alone = scenarios().first().map(|(first, _)| format!("Without a command the scenario {first} runs.\n"));
    text + "\n\n" + &alone.unwrap_or_default()
}

/// What the program was made of, and for what.
fn about_build() -> String {
    let features = [
        ("foxglove", cfg!(feature = "foxglove")),
        ("hosts", cfg!(feature = "hosts")),
        ("parquet", cfg!(feature = "parquet")),
        ("hooks", cfg!(feature = "hooks")),
    ];
    let names = |is_built| features.iter().filter(move |(_, built)| *built == is_built).map(|(name, _)| *name);
    let built: Vec<&str> = names(true).collect();
    // The hooks are for tests alone.
    let absent: Vec<&str> = names(false).filter(|name| *name != "hooks").collect();
    let host = MachineInfo::local();
    format!(
        "revision  {}\nfeatures  {}\niceoryx2  {}\ntarget    {}\nhost      {}, {}, {} cores",
        env!("COROTATE_REVISION"),
        if built.is_empty() { format!("none of {}", absent.join(", ")) } else { built.join(", ") },
        iox::VERSION,
        env!("COROTATE_TARGET"),
        host.kernel,
        host.cpu,
        host.cores,
    )
}

/// Prints the completions for a shell.
pub fn completions(arguments: &CompletionsArguments, definition: clap::Command) -> Ended {
    let (all, mut text) = (named(definition), Vec::new());
    // What help does not tell of is not offered either.
    let shown = all.get_subcommands().filter(|command| !command.is_hide_set()).cloned();
    let mut line = clap::Command::new(name()).version(version());
    line = line.args(all.get_arguments().cloned()).subcommands(shown);
    clap_complete::generate(arguments.shell, &mut line, name(), &mut text);
    say(&String::from_utf8_lossy(&text))
}

/// Writes the manual pages.
pub fn man(arguments: &ManArguments, definition: clap::Command) -> Ended {
    let written = write_pages(arguments, definition);
    say(&written.map_err(|error| {
        fail(Exit::Failure, Failure::new("cannot-write", format!("{error}; name another directory")))
    })?)
}

fn write_pages(ManArguments { directory }: &ManArguments, definition: clap::Command) -> Result<String, String> {
    let failed = |path: &Path| {
        let path = path.display().to_string();
        move |error: io::Error| format!("{path}: {error}")
    };
    files::create_directories(directory).map_err(failed(directory))?;
    let mut root = named(definition).disable_help_subcommand(true).after_long_help(OPTIONS);
    root.build();
    let commands = root.get_subcommands().filter(|command| !command.is_hide_set());
    let mut written = String::new();
    for command in std::iter::once(&root).chain(commands) {
        let extra = command.get_after_long_help().map(ToString::to_string).unwrap_or_default();
        let source = format!("{} {}", name(), version());
        // What the short help leaves out is not to be missing here.
        let whole = command.clone().after_long_help(None).mut_args(|arg| arg.hide_short_help(false));
        let man = clap_mangen::Man::new(whole).source(source);
        let path = directory.join(man.get_filename());
        let mut page = Vec::new();
        man.render(&mut page).map_err(failed(&path))?;
        page.extend(verbatim(&extra).bytes());
        files::write(&path, &page).map_err(failed(&path))?;
        let _ = writeln!(written, "{}", path.display());
    }
    Ok(written)
}

/// The last section of a page: what stands below the long help, line by line as it stands there.
fn verbatim(text: &str) -> String {
    if text.is_empty() {
        return String::new();
    }
    // A full stop or an apostrophe that begins a line would be a command to the formatter.
    let line = |line: &str| format!("\\&{}\n", line.replace('\\', "\\e").replace('-', "\\-"));
    format!(".SH NOTES\n.nf\n{}.fi\n", text.lines().map(line).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_formatter_would_obey_stands_as_it_is() {
        assert_eq!(verbatim(".so x\n  a-b \\"), ".SH NOTES\n.nf\n\\&.so x\n\\&  a\\-b \\e\n.fi\n");
        assert_eq!(verbatim(""), "");
    }
}
