//! Help that fits a screen, the version, completions and manual pages.
//!
//! Must not describe a command twice: all of it is generated from the definition that parses the command line.

use super::color::When;
use super::output::{CommandResult, Exit, Failure, fail, say};
use super::shipped::{name, scenarios, words_given};
use crate::bus::iox;
use crate::files;
use crate::telemetry::MachineInfo;
use clap::{ColorChoice, ValueEnum};
use clap_complete::Shell;
use std::fmt::Write;
use std::io;
use std::path::{Path, PathBuf};

/// Width of help, in columns.
pub const WIDTH: usize = 80;
/// The commands that the overview explains, one per line; it lists the names of the rest.
const FIRST: [&str; 10] = ["run", "check", "init", "new", "report", "watch", "replay", "diff", "export", "doctor"];
const TEMPLATE: &str = "{about}\n\n{usage-heading} {usage}{after-help}";
const OPTIONS: &str = "\
`COMMAND --help` explains a command, with examples; `COMMAND -h` is shorter.
-V prints version and revision, --version more. All take --color auto|always|never.
Exit codes: 0 ok, 1 failure, 2 usage or configuration, 3 not accepted or not
equal, 4 process died, 5 privilege not granted, 128+n ended by signal n";

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
    /// Directory for corotate.1 and one page per command
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

const MAN: &str = "\
Example:
  corotate man ~/.local/share/man/man1 && man corotate-run";

/// Returns the definition of the command line, complete with version and help.
pub fn line(definition: clap::Command) -> clap::Command {
    let line = with_negative_numbers(named(definition));
    let short = format!("{} ({})", version(), env!("COROTATE_BUILT_REVISION"));
    let long = format!("{short}\n{}", about_build());
    let overview = overview(&line) + OPTIONS;
    // Leaked once: the process parses one command line.
    let line = line.version(&*short.leak()).long_version(&*long.leak());
    line.help_template(TEMPLATE).after_help(overview).color(asked_color())
}

/// Accepts a negative number as any value: its parser gives the range, if it is out of range.
fn with_negative_numbers(definition: clap::Command) -> clap::Command {
    let accept = |argument: clap::Arg| {
        let takes_values = argument.get_action().takes_values();
        argument.allow_negative_numbers(takes_values)
    };
    definition.mut_args(accept).mut_subcommands(with_negative_numbers)
}

/// Returns the definition with the program's name and version, equal on every machine.
fn named(definition: clap::Command) -> clap::Command {
    definition.name(name()).version(version())
}

fn version() -> &'static str {
    let (own, with) = (env!("CARGO_PKG_VERSION"), concat!("with corotate ", env!("CARGO_PKG_VERSION")));
    if name() == env!("CARGO_PKG_NAME") { own } else { with }
}

/// Returns the value of `--color`. clap prints help while it parses, so the parsed value is not yet available.
fn asked_color() -> ColorChoice {
    let words: Vec<String> = words_given().iter().map(|word| word.to_string_lossy().into_owned()).collect();
    let separate = words.windows(2).find(|pair| pair[0] == "--color").map(|pair| pair[1].as_str());
    let joined = || words.iter().find_map(|word| word.strip_prefix("--color="));
    match separate.or_else(joined).and_then(|word| When::from_str(word, false).ok()) {
        Some(When::Always) => ColorChoice::Always,
        Some(When::Never) => ColorChoice::Never,
        Some(When::Auto) | None => ColorChoice::Auto,
    }
}

/// Returns the list of commands: the first ones explained, the rest by name, so that help fits a screen.
fn overview(line: &clap::Command) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let visible = || line.get_subcommands().filter(|command| !command.is_hide_set());
    for command in FIRST.iter().filter_map(|first| visible().find(|command| command.get_name() == *first)) {
        let about = command.get_about().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(text, "  {:<9}{about}", command.get_name());
    }
    let rest = visible().map(clap::Command::get_name).filter(|name| !FIRST.contains(name));
    let mut column = 0;
    for name in rest {
        if column == 0 || column + name.len() + 1 > WIDTH {
            let _ = write!(text, "{}", if column == 0 { "  and:" } else { "\n      " });
            column = 6;
        }
        let _ = write!(text, " {name}");
        column += name.len() + 1;
    }
    let alone = scenarios().first().map(|(first, _)| format!("Without a command, `run {first}` is executed.\n"));
    text + "\n\n" + &alone.unwrap_or_default()
}

/// Returns revision, features and target of the build, and the machine.
fn about_build() -> String {
    let features = [
        ("foxglove", cfg!(feature = "foxglove")),
        ("hosts", cfg!(feature = "hosts")),
        ("parquet", cfg!(feature = "parquet")),
        ("hooks", cfg!(feature = "hooks")),
    ];
    let names = |is_built| features.iter().filter(move |(_, built)| *built == is_built).map(|(name, _)| *name);
    let built: Vec<&str> = names(true).collect();
    // The hooks are for tests.
    let absent: Vec<&str> = names(false).filter(|name| *name != "hooks").collect();
    let host = MachineInfo::local();
    format!(
        "revision  {}\nfeatures  {}\niceoryx2  {}\ntarget    {}\nhost      {}, {}, {} cores",
        env!("COROTATE_BUILT_REVISION"),
        if built.is_empty() { format!("none of {}", absent.join(", ")) } else { built.join(", ") },
        iox::VERSION,
        env!("COROTATE_TARGET"),
        host.kernel,
        host.cpu,
        host.cores,
    )
}

/// Prints the completions of a shell.
pub fn completions(arguments: &CompletionsArguments, definition: clap::Command) -> CommandResult {
    let (all, mut text) = (named(definition), Vec::new());
    // Hidden commands are not completed.
    let shown = all.get_subcommands().filter(|command| !command.is_hide_set()).cloned();
    let mut line = clap::Command::new(name()).version(version());
    line = line.args(all.get_arguments().cloned()).subcommands(shown);
    clap_complete::generate(arguments.shell, &mut line, name(), &mut text);
    say(&String::from_utf8_lossy(&text))
}

/// Writes the manual pages.
pub fn man(arguments: &ManArguments, definition: clap::Command) -> CommandResult {
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
        // Manual pages contain the options that the short help omits.
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

/// Returns the last section of a page: the text below the long help, with its line breaks.
fn verbatim(text: &str) -> String {
    if text.is_empty() {
        return String::new();
    }
    // A line that begins with a full stop or an apostrophe is a command to the formatter.
    let line = |line: &str| format!("\\&{}\n", line.replace('\\', "\\e").replace('-', "\\-"));
    format!(".SH NOTES\n.nf\n{}.fi\n", text.lines().map(line).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::super::Arguments;
    use super::*;
    use clap::CommandFactory;
    use clap::error::ErrorKind;

    #[test]
    fn a_negative_number_is_refused_by_the_parser_of_its_option() {
        for words in [
            ["corotate", "why", "--tick", "-3"],
            ["corotate", "watch", "--once", "-1"],
            ["corotate", "set", "--ramp", "-2"],
        ] {
            let refused = line(Arguments::command()).try_get_matches_from(words).unwrap_err();
            assert_eq!(refused.kind(), ErrorKind::ValueValidation, "{words:?}");
        }
    }

    #[test]
    fn formatter_commands_are_escaped() {
        assert_eq!(verbatim(".so x\n  a-b \\"), ".SH NOTES\n.nf\n\\&.so x\n\\&  a\\-b \\e\n.fi\n");
        assert_eq!(verbatim(""), "");
    }
}
