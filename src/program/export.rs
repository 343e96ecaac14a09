//! `corotate export`: converts a recording to tables.

use super::output::{CommandResult, Exit, Failure, fail, say};
use super::record;
use crate::record::{ExportError, Recording, export_csv};
use std::path::PathBuf;

/// Options of `corotate export`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES, group = clap::ArgGroup::new("forms").required(true).multiple(true))]
pub struct Arguments {
    /// A run's directory, a recording, or latest [default: runs/latest]
    run: Option<PathBuf>,
    /// Write one CSV file per signal to this directory
    #[arg(long, value_name = "DIR", group = "forms")]
    csv: Option<PathBuf>,
    /// Write one Parquet file per signal to this directory
    #[arg(long, value_name = "DIR", group = "forms")]
    parquet: Option<PathBuf>,
    /// Accept an incomplete recording
    #[arg(long)]
    accept_incomplete: bool,
    /// Print the paths as one JSON object (corotate/export/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/export/v1";

const EXAMPLES: &str = "\
Every sample is a row: time in the run (s), time of reception (ns), and every
element of every field. Numbers read back to the same bits.

Examples:
  corotate export --csv tables     the newest run in runs/
  head -2 tables/leader.estimate.csv
  corotate export runs/20261121T150000Z-rigid-pair --parquet tables";

/// The reason for refusal if the program was built without Parquet.
const REFUSAL: &str =
    "--parquet: this program was built without Parquet; build it with `cargo build --release --features parquet`";

/// Executes `corotate export`.
pub fn export(arguments: &Arguments) -> CommandResult {
    if arguments.parquet.is_some() && !cfg!(feature = "parquet") {
        return Err(fail(Exit::Usage, Failure::new("built-without", REFUSAL)));
    }
    let (file, recording) = record::open_run(arguments.run.as_deref(), arguments.accept_incomplete)?;
    let files = write(arguments, &recording).map_err(|error| fail(exit_of(&error), error))?;
    let names: Vec<String> = files.iter().map(|path| path.display().to_string()).collect();
    let text = if arguments.json {
        let object = serde_json::json!({ "schema": SCHEMA, "file": file.display().to_string(), "tables": names });
        format!("{object}\n")
    } else {
        names.iter().map(|name| format!("{name}\n")).collect()
    };
    say(&text).map(|exit| record::exit_with(&recording, exit))
}

fn write(arguments: &Arguments, recording: &Recording) -> Result<Vec<PathBuf>, ExportError> {
    let mut files = Vec::new();
    if let Some(directory) = &arguments.csv {
        files.extend(export_csv(recording, directory)?);
    }
    #[cfg(feature = "parquet")]
    if let Some(directory) = &arguments.parquet {
        files.extend(crate::record::export_parquet(recording, directory)?);
    }
    Ok(files)
}

fn exit_of(error: &ExportError) -> Exit {
    match error {
        ExportError::Recording(error) => record::exit_of(error),
        ExportError::Write { .. } => Exit::Failure,
        ExportError::Wide { .. } => Exit::Usage,
    }
}
