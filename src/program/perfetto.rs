//! Writes the late ticks and samples of a run as a Chrome trace.

use super::output::{Exit, Failure, remark};
use super::record;
use crate::files;
use crate::late::{LateReport, Perfetto, SampleMark};
use crate::launch::{LATE, RECORDING, SUMMARY};
use crate::record::{RecordError, Recording};
use crate::sample::{NO_SAMPLE, Stamp};
use crate::system::remedy;
use std::fs;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

/// Writes a trace of the run in `source`, a directory or a recording, to the file `out`: its late ticks, and the samples if it was
/// recorded.
///
/// # Errors
/// The exit code and the reason.
pub fn write(source: &Path, report: &LateReport, out: &Path) -> Result<(), (Exit, Failure)> {
    let results = if source.is_dir() {
        [LATE, RECORDING, SUMMARY].map(|name| source.join(name)).to_vec()
    } else {
        vec![source.to_owned()]
    };
    let same = |file: &&PathBuf| matches!([file, out].map(fs::canonicalize), [Ok(a), Ok(b)] if a == b);
    if let Some(file) = results.iter().find(same) {
        let name = file.file_name().unwrap_or_default().display();
        let text = format!("{} is the run's {name}; name another file", out.display());
        return Err((Exit::Usage, Failure::new("same-file", text)));
    }
    let recording = open(source, report)?;
    let failed = |error: io::Error| {
        let text = format!("cannot write {}: {error}; {}, or name another file", out.display(), remedy(&error));
        (Exit::Failure, Failure::new("cannot-write", text))
    };
    let file = files::create(out).map_err(failed)?;
    let mut trace = Perfetto::new(BufWriter::new(&*file), report).map_err(failed)?;
    if let Some(recording) = &recording {
        let written = samples(recording, &mut trace).map_err(|error| (record::exit_of(&error), error.into()))?;
        written.map_err(failed)?;
    }
    trace.finish().map(|_| ()).map_err(failed)
}

/// Opens the recording of the run, if it has one.
fn open(source: &Path, report: &LateReport) -> Result<Option<Recording>, (Exit, Failure)> {
    let file = if source.is_dir() { source.join(RECORDING) } else { source.to_owned() };
    if !file.exists() {
        return Ok(None);
    }
    let recording = record::open(&file, true).map_err(|error| (record::exit_of(&error), error.into()))?;
    if recording.info().run != report.run {
        let text = format!("{} and {LATE} beside it belong to different runs; remove one", file.display());
        return Err((Exit::Usage, Failure::new("two-runs", text)));
    }
    if recording.info().epoch_ns == 0 {
        remark(&format!("{} is not of a run in real time: its samples have no place on the time axis", file.display()));
        return Ok(None);
    }
    Ok(Some(recording))
}

/// Writes all samples. Those with stamps before the first tick are of another clock and are left out.
fn samples(recording: &Recording, trace: &mut Perfetto<BufWriter<&File>>) -> Result<io::Result<()>, RecordError> {
    let names: Vec<String> =
        recording.signals().iter().map(|signal| format!("{}/{}", signal.body, signal.signal)).collect();
    let epoch_ns = recording.info().epoch_ns;
    let mut written = Ok(());
    recording.visit(|index, _, bytes| {
        let stamp: Stamp = bytemuck::pod_read_unaligned(&bytes[..size_of::<Stamp>()]);
        let is_sample = !stamp.is_warm_up() && stamp.generation & NO_SAMPLE == 0;
        let sent_ns = stamp.sent_ns.checked_sub(epoch_ns).and_then(|ns| i64::try_from(ns).ok());
        if let (Ok(()), true, Some(sent_ns)) = (&written, is_sample, sent_ns) {
            let role = &recording.signals()[index].role;
            written = trace.sample(&SampleMark { role, signal: &names[index], tick: stamp.tick, sent_ns });
        }
    })?;
    Ok(written)
}
