//! A serial line: a terminal device in raw mode that is read and written without waiting, and reopened after a cut.
//!
//! Must not know the meaning of its bytes, nor decide how long to wait for a line that is gone.

use crate::serial::MAX_FRAME;
use rustix::fd::OwnedFd;
use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, OptionalActions, QueueSelector, SpecialCodeIndex, isatty, tcflush, tcgetattr, tcsetattr,
};
use std::ffi::CString;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// A line could not be opened.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum LineError {
    /// The system refused.
    #[error("cannot open {}: {source}; {remedy}", path.display())]
    #[strum(serialize = "cannot-open-line")]
    Open {
        /// The device.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
        /// The remedy.
        remedy: &'static str,
    },
    /// The path is not a terminal device.
    #[error("{} is not a serial line (not a terminal device); give one as /dev/ttyUSB0, /dev/ttyACM0, or a pty", path.display())]
    NotATerminal {
        /// The path as given.
        path: PathBuf,
    },
    /// Another program uses the line.
    #[error("{} is in use by another program; end that first", path.display())]
    #[strum(serialize = "line-in-use")]
    InUse {
        /// The device.
        path: PathBuf,
    },
    /// The line cannot be configured.
    #[error("cannot set {} to raw mode{}: {source}; does it know that speed?", path.display(), baud.map_or(String::new(), |baud| format!(" at {baud} baud")))]
    #[strum(serialize = "line-setup")]
    Setup {
        /// The device.
        path: PathBuf,
        /// The requested speed.
        baud: Option<u32>,
        /// The system's reason.
        source: io::Error,
    },
}

/// A serial line, open or cut.
pub struct Line {
    path: PathBuf,
    /// `path` as a C string, so that reopening does not allocate.
    name: CString,
    baud: Option<u32>,
    port: Option<OwnedFd>,
    outgoing: [u8; MAX_FRAME],
    from: usize,
    to: usize,
}

impl Line {
    /// Opens a terminal device exclusively. Without `baud` (bit/s) its speed stays unchanged.
    ///
    /// # Errors
    /// [`LineError`].
    pub fn open(path: &Path, baud: Option<u32>) -> Result<Self, LineError> {
        let name = CString::new(path.as_os_str().as_bytes()).map_err(|_| refused(path, Errno::INVAL))?;
        let port = open_port(path, &name, baud)?;
        Ok(Self { path: path.to_owned(), name, baud, port: Some(port), outgoing: [0; MAX_FRAME], from: 0, to: 0 })
    }

    /// The device.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The requested speed, bit/s.
    pub fn baud(&self) -> Option<u32> {
        self.baud
    }

    /// Returns true unless the line is known to be cut.
    pub fn is_open(&self) -> bool {
        self.port.is_some()
    }

    /// Tries to open the line again.
    ///
    /// # Errors
    /// [`LineError`]; the line then stays cut.
    pub fn reopen(&mut self) -> Result<(), LineError> {
        // The old descriptor is closed first: the device may allow one only.
        self.cut();
        self.port = Some(open_port(&self.path, &self.name, self.baud)?);
        Ok(())
    }

    /// Reads available bytes and returns their number. Closes a line that is found to be cut.
    pub fn read(&mut self, bytes: &mut [u8]) -> usize {
        let Some(port) = &self.port else { return 0 };
        match rustix::io::read(port, bytes) {
            Ok(count) if count > 0 => count,
            Err(Errno::AGAIN | Errno::INTR) => 0,
            // End of the stream, or the error of an unplugged device.
            Ok(_) | Err(_) => {
                self.cut();
                0
            }
        }
    }

    /// Sends a frame after what is left of the previous one. Returns false if the rest of the previous frame was
    /// dropped.
    pub fn write(&mut self, frame: &[u8]) -> bool {
        self.flush();
        let whole = self.from == self.to;
        (self.from, self.to) = (0, frame.len().min(MAX_FRAME));
        self.outgoing[..self.to].copy_from_slice(&frame[..self.to]);
        self.flush();
        whole
    }

    /// Sends as much of the last frame as the line takes.
    pub fn flush(&mut self) {
        while self.from < self.to {
            let Some(port) = &self.port else { return };
            match rustix::io::write(port, &self.outgoing[self.from..self.to]) {
                Ok(count) => self.from += count,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return,
                Err(_) => self.cut(),
            }
        }
    }

    fn cut(&mut self) {
        self.port = None;
        (self.from, self.to) = (0, 0);
    }
}

fn refused(path: &Path, error: Errno) -> LineError {
    let remedy = match error {
        Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::IO => "is the device plugged in, and is this its path?",
        Errno::ACCESS | Errno::PERM => "join the group that owns it (often `dialout`), or change its mode",
        _ => "give the path of a serial line, as /dev/ttyUSB0",
    };
    LineError::Open { path: path.to_owned(), source: error.into(), remedy }
}

fn open_port(path: &Path, name: &CString, baud: Option<u32>) -> Result<OwnedFd, LineError> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let port = match open(name.as_c_str(), flags, Mode::empty()) {
        Ok(port) if isatty(&port) => port,
        Ok(_) | Err(Errno::ISDIR) => return Err(LineError::NotATerminal { path: path.to_owned() }),
        Err(Errno::BUSY) => return Err(LineError::InUse { path: path.to_owned() }),
        Err(error) => return Err(refused(path, error)),
    };
    // Other programs for serial lines take this lock too.
    flock(&port, FlockOperation::NonBlockingLockExclusive).map_err(|_| LineError::InUse { path: path.to_owned() })?;
    set_up(&port, baud).map_err(|error| LineError::Setup { path: path.to_owned(), baud, source: error.into() })?;
    Ok(port)
}

/// Configures eight data bits, no parity, one stop bit, no flow control, no modem lines, no translation.
fn set_up(port: &OwnedFd, baud: Option<u32>) -> rustix::io::Result<()> {
    let mut settings = tcgetattr(port)?;
    settings.make_raw();
    // A board that resets on hang-up must not reset when the bridge ends.
    settings.control_modes -= ControlModes::CSTOPB | ControlModes::CRTSCTS | ControlModes::HUPCL;
    settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
    // A read without data returns an error instead of an end of stream.
    settings.special_codes[SpecialCodeIndex::VMIN] = 1;
    settings.special_codes[SpecialCodeIndex::VTIME] = 0;
    if let Some(baud) = baud {
        settings.set_speed(baud)?;
    }
    tcsetattr(port, OptionalActions::Now, &settings)?;
    tcflush(port, QueueSelector::IFlush)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    /// Returns the far end of a line, and the path of the near end.
    fn pty() -> (OwnedFd, PathBuf) {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&far).unwrap();
        unlockpt(&far).unwrap();
        let name = ptsname(&far, Vec::new()).unwrap();
        (far, PathBuf::from(name.to_str().unwrap()))
    }

    #[test]
    fn bytes_pass_unchanged_and_reads_do_not_block() {
        let (far, path) = pty();
        let mut line = Line::open(&path, Some(115_200)).unwrap();
        let (every, mut bytes) = ((0..=255).collect::<Vec<u8>>(), [0; 512]);
        assert_eq!(line.read(&mut bytes), 0, "no data is not an end of stream");
        assert!(line.is_open() && line.write(&every));
        let mut seen = 0;
        while seen < 256 {
            seen += rustix::io::read(&far, &mut bytes[seen..]).unwrap();
        }
        assert_eq!(bytes[..256], every);
        rustix::io::write(&far, &every).unwrap();
        let mut back = Vec::new();
        while back.len() < 256 {
            let count = line.read(&mut bytes);
            back.extend_from_slice(&bytes[..count]);
        }
        assert_eq!(back, every);
    }

    /// The far end does not read: frames that do not fit are dropped and reported, and no call blocks.
    #[test]
    fn a_full_line_does_not_block_its_writer() {
        let (_far, path) = pty();
        let mut line = Line::open(&path, None).unwrap();
        let lost = (0..2000).filter(|_| !line.write(&[1; MAX_FRAME])).count();
        assert!(lost > 0 && line.is_open());
    }

    #[test]
    fn a_cut_line_is_detected_and_can_be_reopened() {
        let (far, path) = pty();
        let link = tempfile::tempdir().unwrap();
        let link = link.path().join("tty");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        let mut line = Line::open(&link, None).unwrap();
        // The name goes first: another test may reuse the number of the pty at once.
        std::fs::remove_file(&link).unwrap();
        drop(far);
        assert_eq!(line.read(&mut [0; 8]), 0);
        assert!(!line.is_open() && line.reopen().is_err());
        assert!(line.write(b"lost") && line.read(&mut [0; 8]) == 0, "a cut line is not an error");
        let (_far, path) = pty();
        std::os::unix::fs::symlink(&path, &link).unwrap();
        line.reopen().unwrap();
        assert!(line.is_open());
    }

    #[test]
    fn a_path_that_is_not_a_line_is_refused_with_a_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("file");
        std::fs::write(&file, "text").unwrap();
        for path in [directory.path(), &file, Path::new("/dev/null")] {
            let error = Line::open(path, None).err().unwrap();
            assert!(matches!(error, LineError::NotATerminal { .. }), "{error}");
        }
        let error = Line::open(&directory.path().join("none"), None).err().unwrap().to_string();
        assert!(error.contains("plugged in"), "{error}");
        let (_far, path) = pty();
        let _line = Line::open(&path, None).unwrap();
        assert!(matches!(Line::open(&path, None), Err(LineError::InUse { .. })));
    }
}
