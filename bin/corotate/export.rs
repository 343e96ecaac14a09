//! `corotate export`: a recording as tables.

use crate::{Exit, fail, record, say};
use corotate::record::{ExportError, Recording, export_csv};
use std::path::PathBuf;

/// Options of `corotate export`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The recording
    file: PathBuf,
    /// Write one CSV file per signal into this directory
    #[arg(long, value_name = "DIR")]
    csv: PathBuf,
}

const EXAMPLES: &str = "\
Every sample is a row: time in the run in s, when it was received in ns, and every element of every field. Numbers read back
to the same bits.

Example:
  corotate export runs/20261121T150000Z-rigid-pair/run.mcap --csv tables
  head -2 tables/leader.estimate.csv";

/// Exports.
pub fn export(arguments: &Arguments) -> Exit {
    match write(arguments) {
        Ok(files) => {
            let lines: String = files.iter().map(|path| format!("{}\n", path.display())).collect();
            say(&lines).err().unwrap_or(Exit::Ok)
        }
        Err(error) => fail(exit_of(&error), &error),
    }
}

fn write(arguments: &Arguments) -> Result<Vec<PathBuf>, ExportError> {
    let recording = Recording::open(&arguments.file)?;
    if let Some(damage) = recording.damage() {
        eprintln!("corotate: {} is read as far as it goes: {damage}", arguments.file.display());
    }
    export_csv(&recording, &arguments.csv)
}

fn exit_of(error: &ExportError) -> Exit {
    match error {
        ExportError::Recording(error) => record::exit_of(error),
        ExportError::Write { .. } => Exit::Failure,
    }
}
