//! The line to a device: a terminal device in raw mode that is reopened after a cut, or a UDP address with one frame per
//! datagram. Both are read and written without waiting.
//!
//! Must not know the meaning of its bytes, nor decide how long to wait for a line that is gone.

use crate::clock::raw_ns;
use crate::serial::MAX_FRAME;
use rustix::fd::OwnedFd;
use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, OptionalActions, QueueSelector, SpecialCodeIndex, isatty, tcflush, tcgetattr, tcsetattr,
};
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::ffi::CString;
use std::fmt;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// The largest age of a datagram's stamp, ns: an older one is from before the system's clock was set.
const AGE_MAX_NS: u64 = 10_000_000_000;

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
    /// No socket can reach the address.
    #[error("cannot send to {address}: {source}; give the address of a device that this machine has a route to")]
    #[strum(serialize = "no-route")]
    Socket {
        /// The device's address.
        address: SocketAddr,
        /// The system's reason.
        source: io::Error,
    },
}

/// The place of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LineAddress {
    /// A terminal device.
    Serial {
        /// Its path.
        path: PathBuf,
        /// The speed, bit/s; `None` keeps the current one.
        baud: Option<u32>,
    },
    /// An address that receives datagrams.
    Udp(SocketAddr),
}

impl fmt::Display for LineAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial { path, .. } => path.display().fmt(f),
            Self::Udp(address) => write!(f, "udp/{address}"),
        }
    }
}

/// A line to a device, open or cut. A UDP address is never cut.
pub struct Line {
    address: LineAddress,
    /// The path of a terminal device as a C string, so that reopening does not allocate.
    name: CString,
    port: Option<OwnedFd>,
    /// True while the machine of a UDP address answers that no program receives there.
    refused: bool,
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
        Self::to(LineAddress::Serial { path: path.to_owned(), baud })
    }

    /// Opens the line to an address.
    ///
    /// # Errors
    /// [`LineError`].
    pub fn to(address: LineAddress) -> Result<Self, LineError> {
        let name = match &address {
            LineAddress::Serial { path, .. } => {
                CString::new(path.as_os_str().as_bytes()).map_err(|_| refused(path, Errno::INVAL))?
            }
            LineAddress::Udp(_) => CString::default(),
        };
        let port = Some(open_port(&address, &name)?);
        Ok(Self { address, name, port, refused: false, outgoing: [0; MAX_FRAME], from: 0, to: 0 })
    }

    /// The place of the device.
    pub fn address(&self) -> &LineAddress {
        &self.address
    }

    /// Returns true unless the line is known to be cut.
    pub fn is_open(&self) -> bool {
        self.port.is_some()
    }

    /// Returns true if bytes arrive as a stream, so that a read of fewer than asked for has emptied it. Otherwise each
    /// read returns one datagram.
    pub fn is_stream(&self) -> bool {
        matches!(self.address, LineAddress::Serial { .. })
    }

    /// Returns true if the machine at a UDP address has answered the last datagram that no program receives there.
    pub fn is_refused(&self) -> bool {
        self.refused
    }

    /// Tries to open the line again.
    ///
    /// # Errors
    /// [`LineError`]; the line then stays cut.
    pub fn reopen(&mut self) -> Result<(), LineError> {
        // The old descriptor is closed first: the device may allow one only.
        self.cut();
        self.port = Some(open_port(&self.address, &self.name)?);
        Ok(())
    }

    /// Reads available bytes and returns their number. Closes a serial line that is found to be cut.
    pub fn read(&mut self, bytes: &mut [u8]) -> usize {
        let Some(port) = &self.port else { return 0 };
        match rustix::io::read(port, bytes) {
            Ok(count) if count > 0 => {
                self.refused = false;
                count
            }
            Err(Errno::AGAIN | Errno::INTR) => 0,
            // An empty datagram, or the network's answer to an earlier one.
            result if !self.is_stream() => {
                self.refused |= result == Err(Errno::CONNREFUSED);
                0
            }
            // End of the stream, or the error of an unplugged device.
            Ok(_) | Err(_) => {
                self.cut();
                0
            }
        }
    }

    /// Returns the time at which the bytes that were read last arrived, on this host's monotonic clock, ns: of a datagram
    /// that of its arrival in the system, of a stream the present.
    pub fn arrived_ns(&self) -> u64 {
        let socket = self.port.as_ref().filter(|_| !self.is_stream());
        let age_ns = socket.and_then(stamp).and_then(|stamp_ns| realtime_ns().checked_sub(stamp_ns));
        // After the age: if the process is held up between the two, the arrival appears late and never early.
        raw_ns() - age_ns.filter(|age_ns| *age_ns < AGE_MAX_NS).unwrap_or(0)
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
        let mut answered = false;
        while self.from < self.to {
            let Some(port) = &self.port else { return };
            match rustix::io::write(port, &self.outgoing[self.from..self.to]) {
                Ok(count) => self.from += count,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return,
                // The answer to an earlier datagram, once; this one is not sent yet.
                Err(Errno::CONNREFUSED) if !answered => (answered, self.refused) = (true, true),
                // The network has lost the datagram.
                Err(_) if !self.is_stream() => self.from = self.to,
                Err(_) => self.cut(),
            }
        }
    }

    fn cut(&mut self) {
        self.port = None;
        (self.from, self.to) = (0, 0);
    }
}

/// Returns the time at which the last datagram arrived, on the system's realtime clock, ns. The first call switches the
/// stamps on.
#[allow(unsafe_code)]
fn stamp(socket: &OwnedFd) -> Option<u64> {
    /// SIOCGSTAMPNS of the kernel.
    const GET_STAMP: rustix::ioctl::Opcode = 0x8907;
    // SAFETY: this request writes a timespec of the native width, the layout of `Timespec` on systems with 64 bits, and
    // nothing else.
    let stamp = unsafe { rustix::ioctl::ioctl(socket, rustix::ioctl::Getter::<GET_STAMP, Timespec>::new()) };
    stamp.ok().map(nanoseconds)
}

/// Returns the time on the system's realtime clock, ns.
fn realtime_ns() -> u64 {
    nanoseconds(clock_gettime(ClockId::Realtime))
}

fn nanoseconds(time: Timespec) -> u64 {
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

fn refused(path: &Path, error: Errno) -> LineError {
    let remedy = match error {
        Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::IO => "is the device plugged in, and is this its path?",
        Errno::ACCESS | Errno::PERM => "join the group that owns it (often `dialout`), or change its mode",
        _ => "give the path of a serial line, as /dev/ttyUSB0",
    };
    LineError::Open { path: path.to_owned(), source: error.into(), remedy }
}

fn open_port(address: &LineAddress, name: &CString) -> Result<OwnedFd, LineError> {
    match address {
        LineAddress::Serial { path, baud } => open_terminal(path, name, *baud),
        LineAddress::Udp(address) => {
            open_socket(*address).map_err(|source| LineError::Socket { address: *address, source })
        }
    }
}

/// Opens a socket that receives datagrams from this address only.
fn open_socket(address: SocketAddr) -> io::Result<OwnedFd> {
    let own: SocketAddr = match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(own)?;
    socket.connect(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket.into())
}

fn open_terminal(path: &Path, name: &CString, baud: Option<u32>) -> Result<OwnedFd, LineError> {
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

    /// A datagram is a frame. A refusal by the other machine is not a cut, and hides no datagram.
    #[test]
    fn datagrams_pass_whole_over_both_versions_of_the_protocol() {
        for own in ["127.0.0.1:0", "[::1]:0"] {
            let far = UdpSocket::bind(own).unwrap();
            let address = far.local_addr().unwrap();
            let mut line = Line::to(LineAddress::Udp(address)).unwrap();
            let (frame, mut bytes) = ([7; MAX_FRAME], [0; MAX_FRAME]);
            // A loaded system delivers datagrams, and refusals, later.
            let end = std::time::Instant::now() + std::time::Duration::from_secs(20);
            let read = |line: &mut Line, bytes: &mut [u8]| loop {
                let count = line.read(bytes);
                assert!(std::time::Instant::now() < end, "no datagram came");
                if count > 0 {
                    return count;
                }
            };
            assert!(line.write(&frame) && line.read(&mut bytes) == 0 && !line.is_stream());
            let (count, host) = far.recv_from(&mut bytes).unwrap();
            assert_eq!((count, bytes), (MAX_FRAME, frame));
            for length in [3, 0, 5] {
                far.send_to(&frame[..length], host).unwrap();
            }
            assert_eq!([read(&mut line, &mut bytes), read(&mut line, &mut bytes)], [3, 5]);
            // Stamped when it arrives, whenever it is read. The system begins to stamp a moment after the first question.
            loop {
                let before_ns = raw_ns();
                far.send_to(&frame, host).unwrap();
                std::thread::sleep(std::time::Duration::from_millis(20));
                assert_eq!(read(&mut line, &mut bytes), MAX_FRAME);
                let (arrived_ns, read_ns) = (line.arrived_ns(), raw_ns());
                assert!(arrived_ns + 1_000_000 > before_ns && arrived_ns <= read_ns, "{before_ns} {arrived_ns}");
                assert!(std::time::Instant::now() < end, "no stamp came");
                if arrived_ns + 15_000_000 < read_ns {
                    break;
                }
            }
            // Not from another address.
            UdpSocket::bind(own).unwrap().send_to(&frame, host).unwrap();
            far.send_to(&frame[..4], host).unwrap();
            assert_eq!(read(&mut line, &mut bytes), 4);
            drop(far);
            while !line.is_refused() {
                assert!(line.write(&frame) && std::time::Instant::now() < end);
            }
            assert!(line.is_open());
            let far = UdpSocket::bind(address).unwrap();
            assert!(line.write(&frame));
            assert_eq!(far.recv(&mut bytes).unwrap(), MAX_FRAME);
            far.send_to(&frame, host).unwrap();
            assert!(read(&mut line, &mut bytes) == MAX_FRAME && !line.is_refused());
        }
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
