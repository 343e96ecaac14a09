//! Tables as CSV. A number read back has the same bits; a NaN loses its payload.

use super::table::{Table, columns};
use crate::files::Created;
use crate::record::reader::Recording;
use crate::record::track::SignalInfo;
use crate::sample::FieldKind;
use std::io::{self, BufWriter, Write};

pub struct Csv {
    out: BufWriter<Created>,
    kinds: Vec<FieldKind>,
}

impl Table for Csv {
    const EXTENSION: &'static str = "csv";

    fn begin(file: Created, _: &Recording, signal: &SignalInfo) -> io::Result<Self> {
        let (names, kinds): (Vec<_>, Vec<_>) = columns(&signal.layout).into_iter().unzip();
        let mut out = BufWriter::new(file);
        writeln!(out, "{}", names.join(","))?;
        Ok(Self { out, kinds })
    }

    fn row(&mut self, bits: &[u64]) -> io::Result<()> {
        for (index, (word, kind)) in bits.iter().zip(&self.kinds).enumerate() {
            let comma = if index == 0 { "" } else { "," };
            match kind {
                FieldKind::F64 => write!(self.out, "{comma}{:?}", f64::from_bits(*word))?,
                FieldKind::U64 => write!(self.out, "{comma}{word}")?,
            }
        }
        writeln!(self.out)
    }

    fn end(mut self) -> io::Result<()> {
        self.out.flush()
    }
}
