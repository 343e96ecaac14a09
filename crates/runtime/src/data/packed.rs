//! Packed logs, and files that other programs convert. Must not write beside the log.

use super::form::DataError;
use flate2::read::MultiGzDecoder;
use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};
use ruzstd::decoding::StreamingDecoder;
use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::path::Path;

/// The most bytes of an unpacked file, and of an unpacked chunk.
const FILE_BYTES: u64 = 16 << 30;
const CHUNK_BYTES: u64 = 128 << 20;

/// First bytes of files that are not read, what they are, and what converts them.
const FOREIGN: [(&[u8], &str, &str); 11] = [
    (b"SQLite format 3", "a ROS 2 bag in SQLite", "convert it: `mcap convert IN.db3 OUT.mcap`"),
    (b"#ROSBAG", "a ROS 1 bag", "convert it: `mcap convert IN.bag OUT.mcap`"),
    (
        b"PK\x03\x04",
        "a zip archive, or a spreadsheet",
        "unpack the table: `unzip -p IN.zip TABLE > OUT.csv`, or save it as CSV",
    ),
    (b"ULog", "a PX4 log", "convert it: `ulog2csv IN.ulg`"),
    (b"\xa3\x95", "an ArduPilot log", "convert it: `mavlogdump.py --format csv --types IMU IN.bin > OUT.csv`"),
    (b"H Product:Blackbox", "a Betaflight log", "convert it: `blackbox_decode IN.bbl`"),
    (b"\x89HDF", "HDF5", "write its columns as CSV, such as with `pandas.read_hdf(IN).to_csv(OUT)`"),
    (b"MATLAB 5.0", "a MATLAB file", "write its table as CSV: `writetable(T, OUT)`"),
    (b"\x28\xb5\x2f\xfd", "packed with zstd", "unpack it: `zstd -d IN`"),
    (b"{\"", "JSON", JSON),
    (b"[{", "JSON", JSON),
];
const JSON: &str = "write its columns as CSV, such as with `pandas.read_json(IN).to_csv(OUT)`";
/// The most bytes of those.
pub const START_BYTES: u64 = 18;

/// Returns the error for a file of another program; `start` are its first bytes.
pub fn foreign(start: &[u8], path: &Path) -> Option<DataError> {
    let (_, what, remedy) = FOREIGN.iter().find(|(magic, ..)| start.starts_with(magic))?;
    Some(DataError::Form { path: path.to_owned(), line: 0, reason: format!("it is {what}; {remedy}") })
}

/// Unpacks a file of gzip into one without a name; `None` if it is not packed.
pub fn unpacked(start: &[u8], file: &mut File) -> io::Result<Option<File>> {
    if !start.starts_with(b"\x1f\x8b") {
        return Ok(None);
    }
    let mut whole = tempfile::tempfile()?;
    let count = io::copy(&mut MultiGzDecoder::new(file).take(FILE_BYTES), &mut whole)?;
    if count == FILE_BYTES {
        return Err(io::Error::other("it unpacks to more than 16 GiB"));
    }
    whole.flush()?;
    whole.rewind()?;
    Ok(Some(whole))
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
        for (magic, what, _) in FOREIGN {
            std::fs::write(&path, [magic, &[0; 40]].concat()).unwrap();
            let refused = Log::open(&path, &Options::default()).err().unwrap().to_string();
            assert!(refused.contains(what), "{refused}");
        }
    }
}
