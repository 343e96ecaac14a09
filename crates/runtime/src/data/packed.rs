//! Packed logs, and files that other programs convert. Must not write beside the log.

use super::form::DataError;
use flate2::read::MultiGzDecoder;
use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};
use ruzstd::decoding::StreamingDecoder;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// The most bytes of an unpacked file, and of an unpacked chunk.
const FILE_BYTES: u64 = 16 << 30;
const CHUNK_BYTES: u64 = 128 << 20;

/// First bytes of files that are not read, what they are, and what converts them.
const FOREIGN: [(&[u8], &str, &str); 11] = [
    (b"SQLite format 3", "a ROS 2 bag in SQLite", "convert it: `mcap convert IN.db3 OUT.mcap`"),
    (b"#ROSBAG", "a ROS 1 bag", "convert it: `mcap convert IN.bag OUT.mcap`"),
    (ZIP, "a zip archive without a table, or a spreadsheet", "save its table as CSV"),
    (b"ULog", "a PX4 log", "convert it: `ulog2csv IN.ulg`"),
    (b"\xa3\x95", "an ArduPilot log", "convert it: `mavlogdump.py --format csv --types IMU IN.bin > OUT.csv`"),
    (b"H Product:Blackbox", "a Betaflight log", "convert it: `blackbox_decode IN.bbl`"),
    (b"\x89HDF", "HDF5", "write its columns as CSV, such as with `pandas.read_hdf(IN).to_csv(OUT)`"),
    (b"MATLAB 5.0", "a MATLAB file", "write its table as CSV: `writetable(T, OUT)`"),
    (b"\x28\xb5\x2f\xfd", "packed with zstd", "unpack it: `zstd -d IN`"),
    (b"{\"", "JSON", JSON),
    (b"[{", "JSON", JSON),
];
const ZIP: &[u8] = b"PK\x03\x04";
const JSON: &str = "write its columns as CSV, such as with `pandas.read_json(IN).to_csv(OUT)`";
/// The most bytes of those.
pub const START_BYTES: u64 = 18;

/// Returns the error for a file of another program; `start` are its first bytes.
pub fn foreign(start: &[u8], path: &Path) -> Option<DataError> {
    let (_, what, remedy) = FOREIGN.iter().find(|(magic, ..)| start.starts_with(magic))?;
    Some(DataError::Form { path: path.to_owned(), line: 0, reason: format!("it is {what}; {remedy}") })
}

/// Unpacks a file of gzip, or the table in a zip archive, into one without a name; returns it with its name in messages, or `None`
/// if it is not packed.
pub fn unpacked(start: &[u8], file: &mut File, path: &Path) -> Result<Option<(File, PathBuf)>, DataError> {
    let failed = |source| DataError::Read { path: path.to_owned(), source };
    if start.starts_with(b"\x1f\x8b") {
        return whole(MultiGzDecoder::new(file)).map(|whole| Some((whole, path.to_owned()))).map_err(failed);
    }
    if !start.starts_with(ZIP) {
        return Ok(None);
    }
    let mut archive = ZipArchive::new(file).map_err(|error| failed(error.into()))?;
    let names: Vec<String> = archive.file_names().map(str::to_owned).collect();
    let found = table(&names).map_err(|tables| {
        let reason = format!("it has more than one table: {tables}; unpack one: `unzip -p IN.zip TABLE > OUT.csv`");
        DataError::Form { path: path.to_owned(), line: 0, reason }
    })?;
    let Some(name) = found else { return Ok(None) };
    let unpack = |file: &mut ZipArchive<_>| whole(file.by_name(name)?);
    unpack(&mut archive).map(|whole| Some((whole, path.join(name)))).map_err(failed)
}

/// Returns the name of an archive's only table, gyroscope or CSV file, `None` without a table, or else the names of all.
fn table(names: &[String]) -> Result<Option<&str>, String> {
    let ends = |name: &str, ends: &[&str]| ends.iter().any(|end| name.to_lowercase().ends_with(end));
    let about = |name: &str| name.split('/').any(|part| matches!(part, "meta" | "__MACOSX"));
    let all =
        names.iter().map(String::as_str).filter(|name| ends(name, &[".csv", ".tsv", ".txt", ".dat"]) && !about(name));
    let all: Vec<&str> = all.collect();
    let gyro = |name: &str| name.to_lowercase().contains("gyro") && !name.to_lowercase().contains("uncalibrated");
    let only = |fits: &dyn Fn(&str) -> bool| match all.iter().filter(|name| fits(name)).collect::<Vec<_>>()[..] {
        [name] => Some(*name),
        _ => None,
    };
    let found = only(&|_| true).or_else(|| only(&gyro)).or_else(|| only(&|name| ends(name, &[".csv"])));
    if found.is_some() || all.is_empty() { Ok(found) } else { Err(all.join(", ")) }
}

/// Copies what a reader unpacks into a file without a name.
fn whole(packed: impl Read) -> io::Result<File> {
    let mut whole = tempfile::tempfile()?;
    if io::copy(&mut packed.take(FILE_BYTES), &mut whole)? == FILE_BYTES {
        return Err(io::Error::other("it unpacks to more than 16 GiB"));
    }
    whole.rewind()?;
    Ok(whole)
}

/// Unpacks chunks of zstd, each once all of its bytes have come.
#[derive(Default)]
pub struct Zstd {
    unpacked: Vec<u8>,
    given: usize,
}

impl Decompressor for Zstd {
    fn next_read_size(&self) -> usize {
        0
    }

    fn decompress(&mut self, src: &[u8], dst: &mut [u8]) -> McapResult<DecompressResult> {
        let mut rest = src;
        if self.given == self.unpacked.len() {
            (self.given, self.unpacked) = (0, Vec::new());
            let unpack = |rest: &mut &[u8], into: &mut Vec<u8>| -> io::Result<usize> {
                let decoder = StreamingDecoder::new(rest).map_err(io::Error::other)?;
                decoder.take(CHUNK_BYTES).read_to_end(into)
            };
            if unpack(&mut rest, &mut self.unpacked).is_err() {
                // The reader calls again with more of the chunk, or fails at its end.
                self.unpacked.clear();
                return Ok(DecompressResult { consumed: 0, wrote: 0 });
            }
            if self.unpacked.len() as u64 == CHUNK_BYTES {
                return Err(McapError::DecompressionError("a chunk unpacks to more than 128 MiB".to_owned()));
            }
        }
        let wrote = dst.len().min(self.unpacked.len() - self.given);
        dst[..wrote].copy_from_slice(&self.unpacked[self.given..self.given + wrote]);
        self.given += wrote;
        Ok(DecompressResult { consumed: src.len() - rest.len(), wrote })
    }

    fn reset(&mut self) -> McapResult<()> {
        *self = Self::default();
        Ok(())
    }

    fn name(&self) -> &'static str {
        "zstd"
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Log, Options};
    use super::*;
    use flate2::{Compression, write::GzEncoder};
    use std::io::Write;
    use zip::{ZipWriter, write::SimpleFileOptions};

    const TABLE: &[u8] = b"t_s,x,y,z\n0,1,2,3\n0.1,1,2,3\n";

    #[test]
    fn a_packed_table_is_read_and_foreign_files_are_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log.csv.gz");
        let mut encoder = GzEncoder::new(File::create(&path).unwrap(), Compression::default());
        encoder.write_all(b"t_s,wx_dps,wy_dps,wz_dps\n0,1,2,3\n0.1,1,2,3\n").unwrap();
        encoder.finish().unwrap();
        assert_eq!(Log::open(&path, &Options::default()).unwrap().map(Result::unwrap).count(), 2);
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
        assert!(matches!(Log::open(&path, &Options::default()).err().unwrap(), DataError::Read { .. }));
        for (magic, what, _) in FOREIGN.into_iter().filter(|(magic, ..)| *magic != ZIP) {
            std::fs::write(&path, [magic, &[0; 40]].concat()).unwrap();
            let refused = Log::open(&path, &Options::default()).err().unwrap().to_string();
            assert!(refused.contains(what), "{refused}");
        }
    }

    #[test]
    fn the_table_of_an_archive_is_read_if_it_is_certain() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log.zip");
        let open = |names: &[&str]| {
            let mut writer = ZipWriter::new(File::create(&path).unwrap());
            for name in names {
                writer.start_file(*name, SimpleFileOptions::default()).unwrap();
                writer.write_all(TABLE).unwrap();
            }
            writer.finish().unwrap();
            Log::open(&path, &Options::default())
        };
        for names in [
            &["a/Gyroscope.csv"][..],
            &["meta/time.csv", "Gyroscope.csv", "meta/device.csv", "__MACOSX/._Gyroscope.csv", "photo.jpg"],
            &["Accelerometer.csv", "GyroscopeUncalibrated.csv", "Gyroscope.csv", "Metadata.csv"],
            &["README.txt", "gyro/angular.csv", "notes.txt"],
        ] {
            let log = open(names).unwrap();
            assert!(log.path().starts_with(&path) && log.path() != path, "{names:?}");
            assert_eq!(log.map(Result::unwrap).count(), 2, "{names:?}");
        }
        for (names, part) in
            [(&["a.csv", "b.csv"][..], "a.csv, b.csv; unpack one"), (&["xl/workbook.xml"], "spreadsheet")]
        {
            let refused = open(names).err().unwrap().to_string();
            assert!(refused.contains(part), "{refused}");
        }
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
        assert!(matches!(Log::open(&path, &Options::default()), Err(DataError::Read { .. })));
    }
}
