//! Files on a machine with other users: private directories, and safe writing where other users can write too.
//!
//! This file does not know what the files contain.

use crate::system::random_bits;
use rustix::fs::{AtFlags, CWD, FileType, FlockOperation, Mode, OFlags, PROC_SUPER_MAGIC};
use rustix::fs::{
    fcntl_setfl, flock, fstat, fstatfs, ftruncate, mkdirat, openat, readlinkat, renameat, statat, symlinkat, unlinkat,
};
use rustix::io::Errno;
use std::ffi::OsString;
use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read};
use std::ops::Deref;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Component, Path, PathBuf};

/// The permission bits of other users.
const OTHERS: u32 = 0o077;
/// The write permission bits of other users.
const OTHERS_WRITE: u32 = 0o022;
/// The sticky bit: only the owner of a file can remove it from the directory.
const STICKY: u32 = 0o1000;
/// The largest number of links followed on a path, as in the kernel.
const LINKS_MAX: u32 = 40;
/// The number of attempts to open a file that changes meanwhile.
const ATTEMPTS: u32 = 100;
/// The user id that stands for all users outside the user namespace.
const OVERFLOW_USER: u32 = 65_534;

/// The reason why a directory is not private to this user.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum PrivacyError {
    /// It belongs to another user.
    #[error("{} belongs to {owner}, not to {}; unset XDG_RUNTIME_DIR or set it to a directory of your own", path.display(), user_name(user()))]
    #[strum(serialize = "foreign-directory")]
    Foreign {
        /// The directory.
        path: PathBuf,
        /// Its owner.
        owner: String,
    },
    /// Other users have permissions on it.
    #[error("{} is open to other users (mode {:03o}); take it from them with `chmod 700`, or remove it", path.display(), mode & 0o7777)]
    #[strum(serialize = "open-directory")]
    Open {
        /// The directory.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// Other users can replace it.
    #[error("{} lies in {}, where {who} can put another in its place; set XDG_RUNTIME_DIR to a directory of your own", path.display(), ancestor.display())]
    #[strum(serialize = "exposed-directory")]
    Exposed {
        /// The directory.
        path: PathBuf,
        /// The directory above it that is not safe.
        ancestor: PathBuf,
        /// The user who can write to that.
        who: String,
    },
    /// It is not a directory.
    #[error("{} is not a directory; remove it, or set XDG_RUNTIME_DIR to a directory of your own", path.display())]
    NotADirectory {
        /// The path.
        path: PathBuf,
    },
    /// It cannot be examined.
    #[error("cannot look at {}: {source}; set XDG_RUNTIME_DIR to a directory of your own", path.display())]
    #[strum(serialize = "cannot-examine")]
    System {
        /// The directory, or one that it lies in.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// Returns the user of this process.
pub(crate) fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// Returns a user's name and number, or the number alone if the name is unknown.
pub(crate) fn user_name(user: u32) -> String {
    let known = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let named = known.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(user)).then(|| format!("{name} (uid {user})"))
    });
    named.unwrap_or_else(|| format!("uid {user}"))
}

/// Returns true if files need no protection from this user: the process's own user, or root. In a user namespace without root,
/// the overflow user stands for root.
fn is_trusted(owner: u32) -> bool {
    owner == 0 || owner == user() || owner == OVERFLOW_USER && !has_overflow_user()
}

/// Returns true if this user namespace maps the overflow user id to a real user.
fn has_overflow_user() -> bool {
    let map = fs::read_to_string("/proc/self/uid_map").unwrap_or_default();
    map.lines().any(|line| {
        let mut numbers = line.split_whitespace().map(str::parse::<u64>);
        let (first, count) = (numbers.next(), numbers.nth(1));
        matches!((first, count), (Some(Ok(first)), Some(Ok(count))) if (first..first + count).contains(&OVERFLOW_USER.into()))
    })
}

/// Returns the path without links, after checking that the directory belongs to this user, is closed to others, and cannot be
/// replaced by anyone but root. The directory and its content then stay what they are.
///
/// # Errors
/// [`PrivacyError`].
pub fn require_private(path: &Path) -> Result<PathBuf, PrivacyError> {
    let look = |path: &Path| -> Result<Metadata, PrivacyError> {
        fs::symlink_metadata(path).map_err(|source| PrivacyError::System { path: path.to_owned(), source })
    };
    let about = look(path)?;
    if about.uid() != user() {
        return Err(PrivacyError::Foreign { path: path.to_owned(), owner: user_name(about.uid()) });
    }
    if !about.is_dir() {
        return Err(PrivacyError::NotADirectory { path: path.to_owned() });
    }
    if about.mode() & OTHERS != 0 {
        return Err(PrivacyError::Open { path: path.to_owned(), mode: about.mode() });
    }
    let whole = fs::canonicalize(path).map_err(|source| PrivacyError::System { path: path.to_owned(), source })?;
    for ancestor in whole.ancestors().skip(1) {
        let about = look(ancestor)?;
        let by_others = about.mode() & OTHERS_WRITE != 0 && about.mode() & STICKY == 0;
        if by_others || !is_trusted(about.uid()) {
            let who = if by_others { "other users".to_owned() } else { user_name(about.uid()) };
            return Err(PrivacyError::Exposed { path: whole.clone(), ancestor: ancestor.to_owned(), who });
        }
    }
    // The directory examined by the given path must be the one at the path without links.
    let same = |a: &Metadata, b: &Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    if same(&about, &look(&whole)?) { Ok(whole) } else { Err(PrivacyError::NotADirectory { path: path.to_owned() }) }
}

/// Checks that an open file is a regular file of this user with a single hard link.
///
/// # Errors
/// The property that is wrong.
pub fn require_own(file: &File) -> io::Result<()> {
    let about = file.metadata()?;
    if about.is_file() && about.uid() == user() && about.nlink() == 1 {
        return Ok(());
    }
    let reason = if !about.is_file() {
        "it is not a regular file".to_owned()
    } else if about.uid() != user() {
        format!("it belongs to {}", user_name(about.uid()))
    } else {
        format!("it has {} hard links", about.nlink())
    };
    Err(io::Error::other(format!("not a file of this program: {reason}")))
}

/// Opens a regular file, and refuses anything else. It never waits for another process, as opening a FIFO does.
///
/// # Errors
/// Errors of the system; [`InvalidInput`](io::ErrorKind::InvalidInput) for a file that is not regular.
pub fn open_with(path: &Path, options: &mut OpenOptions, flags: OFlags) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY | flags;
    let irregular = || io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file");
    match options.custom_flags(flags.bits() as i32).open(path) {
        // Opening a socket, or a FIFO without reader, fails with this error.
        Err(error) if error.raw_os_error() == Some(libc::ENXIO) => Err(irregular()),
        file => file.and_then(|file| if file.metadata()?.is_file() { Ok(file) } else { Err(irregular()) }),
    }
}

/// Opens a regular file to read it, as [`open_with`] does; links are followed.
///
/// # Errors
/// As [`open_with`].
pub fn open(path: &Path) -> io::Result<File> {
    open_with(path, OpenOptions::new().read(true), OFlags::empty())
}

/// Reads a regular file, as [`open`] opens it.
///
/// # Errors
/// As [`open_with`].
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Locks an open file until it is closed, however the process ends. Returns false if the path leads to another file by now:
/// the process that held the lock has removed the file, and a lock on it protects nothing.
///
/// # Errors
/// Errors of the system; [`WouldBlock`](io::ErrorKind::WouldBlock) if another process holds the lock.
pub fn lock(file: &File, path: &Path) -> io::Result<bool> {
    lock_now(file)?;
    let held = file.metadata()?;
    let same = |at_path: Metadata| (at_path.dev(), at_path.ino()) == (held.dev(), held.ino());
    Ok(fs::symlink_metadata(path).is_ok_and(same))
}

/// Locks a file, or fails at once if another process holds a lock. Retries after signals.
fn lock_now(file: impl AsFd) -> Result<(), Errno> {
    let mut locked = Err(Errno::INTR);
    for _ in 0..ATTEMPTS {
        locked = flock(&file, FlockOperation::NonBlockingLockExclusive);
        if locked != Err(Errno::INTR) {
            break;
        }
    }
    locked
}

/// An open directory. Operations in it stay in this directory, even if its path is changed.
#[derive(Debug)]
pub struct Directory(OwnedFd);

impl Directory {
    /// Opens a directory; no component of the path may be a link of another user.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn open(path: &Path) -> io::Result<Self> {
        match locate(path)? {
            Place { directory, name: None, .. } => Ok(directory),
            _ => Err(io::ErrorKind::NotADirectory.into()),
        }
    }

    /// Returns a path to the directory, valid while it is open.
    pub fn path(&self) -> PathBuf {
        PathBuf::from(format!("/proc/self/fd/{}", self.0.as_raw_fd()))
    }
}

/// The result of following a path.
struct Place {
    directory: Directory,
    /// The last component, which is not a link to follow; `None` if the path is the directory itself.
    name: Option<OsString>,
    /// True if the name is an entry of /proc for an open file.
    is_open: bool,
}

/// Follows a path step by step. Refuses a link of another user, who controls where it leads.
fn locate(path: &Path) -> io::Result<Place> {
    const STEP: OFlags = OFlags::PATH.union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);
    let open = |directory: &OwnedFd, name: &Path| openat(directory, name, STEP | OFlags::DIRECTORY, Mode::empty());
    let steps = |path: &Path| -> Vec<PathBuf> { path.components().rev().map(|step| step.as_os_str().into()).collect() };
    let mut directory = openat(CWD, ".", STEP | OFlags::DIRECTORY, Mode::empty())?;
    let (mut left, mut links) = (steps(path), 0);
    while let Some(step) = left.pop() {
        if !matches!(Path::new(&step).components().next(), Some(Component::Normal(_))) {
            directory = open(&directory, &step)?;
            continue;
        }
        let name = step.clone().into_os_string();
        let found = match openat(&directory, &step, STEP, Mode::empty()) {
            Err(Errno::NOENT) if left.is_empty() => {
                return Ok(Place { directory: Directory(directory), name: Some(name), is_open: false });
            }
            found => found?,
        };
        let about = fstat(&found)?;
        match FileType::from_raw_mode(about.st_mode) {
            FileType::Symlink if fstatfs(&directory)?.f_type == PROC_SUPER_MAGIC && left.is_empty() => {
                return Ok(Place { directory: Directory(directory), name: Some(name), is_open: true });
            }
            FileType::Symlink => {
                links += 1;
                if links > LINKS_MAX {
                    return Err(Errno::LOOP.into());
                }
                if !is_trusted(about.st_uid) {
                    let owner = user_name(about.st_uid);
                    let reason = format!("{} is a link of {owner}, and is not followed", step.display());
                    return Err(io::Error::new(io::ErrorKind::PermissionDenied, reason));
                }
                let target = OsString::from_vec(readlinkat(&found, "", Vec::new())?.into_bytes());
                left.extend(steps(Path::new(&target)));
            }
            FileType::Directory => directory = found,
            _ if left.is_empty() => {
                return Ok(Place { directory: Directory(directory), name: Some(name), is_open: false });
            }
            _ => return Err(Errno::NOTDIR.into()),
        }
    }
    Ok(Place { directory: Directory(directory), name: None, is_open: false })
}

/// Opens a file for rewriting, as [`File::create`] does. It follows no link of another user, and replaces a file with several
/// hard links, since another name may be anywhere. Refuses a file that another process is writing.
///
/// # Errors
/// Errors of the system.
pub fn create(path: &Path) -> io::Result<Created> {
    open_for_rewriting(path).map(Created)
}

/// A file being rewritten. No other process can open it this way until it is dropped.
#[derive(Debug)]
pub struct Created(File);

impl From<File> for Created {
    fn from(file: File) -> Self {
        Self(file)
    }
}

impl Deref for Created {
    type Target = File;

    fn deref(&self) -> &File {
        &self.0
    }
}

impl io::Write for Created {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Drop for Created {
    fn drop(&mut self) {
        // Closing is not enough: a process that another thread has just forked holds the file until it executes its program.
        let _ = self.0.unlock();
    }
}

fn open_for_rewriting(path: &Path) -> io::Result<File> {
    const WRITE: OFlags = OFlags::WRONLY.union(OFlags::NOCTTY).union(OFlags::CLOEXEC);
    for _ in 0..ATTEMPTS {
        let Place { directory, name, is_open } = locate(path)?;
        let Some(name) = name else { return Err(Errno::ISDIR.into()) };
        if is_open {
            return Ok(openat(&directory.0, &name, WRITE | OFlags::TRUNC, Mode::empty())?.into());
        }
        let new = WRITE | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW;
        let file = match openat(&directory.0, &name, new, Mode::from_raw_mode(0o666)) {
            // Does not wait for the reader of a FIFO.
            Err(Errno::EXIST) => {
                openat(&directory.0, &name, WRITE | OFlags::NOFOLLOW | OFlags::NONBLOCK, Mode::empty())
            }
            made => {
                let file = made?;
                let _ = lock_now(&file);
                return Ok(file.into());
            }
        };
        let file = match file {
            // Meanwhile the file was removed, or a link was created.
            Err(Errno::NOENT | Errno::LOOP) => continue,
            Err(Errno::NXIO) => return Err(io::Error::other("it is a socket, or a FIFO that has no reader")),
            file => file?,
        };
        fcntl_setfl(&file, OFlags::empty())?;
        let about = fstat(&file)?;
        if FileType::from_raw_mode(about.st_mode) == FileType::RegularFile {
            // A file system without locks is accepted.
            if lock_now(&file) == Err(Errno::WOULDBLOCK) {
                return Err(io::Error::other("another process is writing it"));
            }
            if about.st_nlink > 1 {
                unlinkat(&directory.0, &name, AtFlags::empty())?;
                continue;
            }
            ftruncate(&file, 0)?;
        }
        return Ok(file.into());
    }
    Err(io::Error::other("another process keeps changing it"))
}

/// Writes a file that is opened by [`create`].
///
/// # Errors
/// Errors of the system.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    io::Write::write_all(&mut create(path)?, bytes)
}

/// Creates a directory that must not exist. Follows no link of another user.
///
/// # Errors
/// Errors of the system.
pub fn create_directory(path: &Path) -> io::Result<()> {
    let Place { directory, name, .. } = locate(path)?;
    let Some(name) = name else { return Err(Errno::EXIST.into()) };
    Ok(mkdirat(&directory.0, name, Mode::from_raw_mode(0o777))?)
}

/// Creates a directory and its missing parents. Follows no link of another user.
///
/// # Errors
/// Errors of the system.
pub fn create_directories(path: &Path) -> io::Result<()> {
    let mut ancestors: Vec<&Path> = path.ancestors().filter(|path| !path.as_os_str().is_empty()).collect();
    ancestors.reverse();
    for path in ancestors {
        let Place { directory, name: Some(name), .. } = locate(path)? else { continue };
        match mkdirat(&directory.0, &name, Mode::from_raw_mode(0o777)) {
            // Possibly created by another process meanwhile.
            Err(Errno::EXIST) => {
                let about = statat(&directory.0, &name, AtFlags::SYMLINK_NOFOLLOW)?;
                if FileType::from_raw_mode(about.st_mode) != FileType::Directory {
                    return Err(Errno::NOTDIR.into());
                }
            }
            made => made?,
        }
    }
    Ok(())
}

/// Creates or replaces a link in a directory in one step: a reader finds the old link or the new one. Nothing that has the
/// link's name is followed.
///
/// # Errors
/// Errors of the system; [`AlreadyExists`](io::ErrorKind::AlreadyExists) if something other than a link has the name.
pub fn link(directory: &Path, name: &str, target: &Path) -> io::Result<()> {
    let Directory(directory) = Directory::open(directory)?;
    match statat(&directory, name, AtFlags::SYMLINK_NOFOLLOW) {
        Err(Errno::NOENT) => {}
        about if FileType::from_raw_mode(about?.st_mode) == FileType::Symlink => {}
        _ => return Err(io::Error::new(io::ErrorKind::AlreadyExists, format!("{name} is there and is not a link"))),
    }
    let beside = format!(".{name}-{:032x}", random_bits()?);
    symlinkat(target, &directory, &beside)?;
    renameat(&directory, &beside, &directory, name).map_err(|error| {
        let _ = unlinkat(&directory, &beside, AtFlags::empty());
        error.into()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, chown, lchown, symlink};

    const NOBODY: u32 = 65_534;

    fn root() -> bool {
        let root = rustix::process::geteuid().is_root();
        if !root {
            // Bypasses the test harness, which captures printed output.
            let _ = io::Write::write_all(
                &mut io::stderr(),
                b"SKIPPED: files of another user because only root can make them\n",
            );
        }
        root
    }

    fn set_mode(path: &Path, mode: u32) {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    }

    #[test]
    fn a_private_directory_is_own_closed_and_cannot_be_replaced() {
        let outer = tempfile::tempdir().unwrap();
        let path = outer.path().join("in");
        let refused = || require_private(&path).unwrap_err().to_string();
        assert!(matches!(require_private(&path), Err(PrivacyError::System { .. })));
        fs::create_dir(&path).unwrap();
        for mode in [0o755, 0o701, 0o720, 0o777] {
            set_mode(&path, mode);
            assert!(refused().contains(&format!("mode {mode:03o}")), "{}", refused());
        }
        set_mode(&path, 0o700);
        assert_eq!(require_private(&path).unwrap(), fs::canonicalize(&path).unwrap());
        // Another user could rename it.
        for mode in [0o777, 0o770] {
            set_mode(outer.path(), mode);
            assert!(refused().contains("where other users can put another"), "{}", refused());
        }
        set_mode(outer.path(), 0o1777);
        require_private(&path).unwrap();
        let link = outer.path().join("link");
        symlink(&path, &link).unwrap();
        assert!(matches!(require_private(&link), Err(PrivacyError::NotADirectory { .. })));
        if root() {
            chown(&path, Some(NOBODY), None).unwrap();
            assert!(refused().contains("(uid 65534), not to root (uid 0)"), "{}", refused());
            chown(&path, Some(0), None).unwrap();
            chown(outer.path(), Some(NOBODY), None).unwrap();
            assert!(refused().contains("(uid 65534) can put another"), "{}", refused());
        }
    }

    #[test]
    fn a_file_is_rewritten_through_own_links_only() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        create_directories(&at("a/b/c")).unwrap();
        create_directories(&at("a/b/c/")).unwrap();
        symlink("a/b", at("short")).unwrap();
        write(&at("short/../b/c/file"), b"one, and long").unwrap();
        symlink(at("short/c/file"), at("link")).unwrap();
        write(&at("link"), b"two").unwrap();
        assert_eq!(fs::read(at("a/b/c/file")).unwrap(), b"two");
        // A dangling link creates its target.
        symlink("a/new", at("dangling")).unwrap();
        write(&at("dangling"), b"three").unwrap();
        assert_eq!(fs::read(at("a/new")).unwrap(), b"three");
        // A hard link's other name keeps its content.
        fs::hard_link(at("a/new"), at("second")).unwrap();
        write(&at("second"), b"four").unwrap();
        assert_eq!([fs::read(at("a/new")).unwrap(), fs::read(at("second")).unwrap()], [&b"three"[..], b"four"]);
        assert!(write(&at("a"), b"").is_err() && write(&at("a/new/x"), b"").is_err());
        assert!(create_directories(&at("a/new")).is_err() && create_directory(&at("a")).is_err());
        symlink("loop", at("loop")).unwrap();
        assert_eq!(write(&at("loop"), b"").unwrap_err().raw_os_error(), Some(Errno::LOOP.raw_os_error()));
        assert!(Directory::open(&at("short")).unwrap().path().join("c").is_dir());
        for device in ["/dev/null", "/dev/fd/2"] {
            write(Path::new(device), b"").unwrap();
        }
    }

    #[test]
    fn a_link_is_put_in_the_place_of_a_link_and_of_nothing_else() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        for target in ["a", "b"] {
            fs::create_dir(at(target)).unwrap();
            link(directory.path(), "latest", Path::new(target)).unwrap();
            assert_eq!(fs::read_link(at("latest")).unwrap(), Path::new(target));
        }
        if root() {
            // Another user's link is replaced, and its target is left alone.
            fs::write(at("secret"), b"kept").unwrap();
            fs::remove_file(at("latest")).unwrap();
            symlink("secret", at("latest")).unwrap();
            lchown(at("latest"), Some(NOBODY), None).unwrap();
            link(directory.path(), "latest", Path::new("a")).unwrap();
            assert_eq!(fs::read(at("secret")).unwrap(), b"kept");
            fs::remove_file(at("secret")).unwrap();
        }
        fs::remove_file(at("latest")).unwrap();
        fs::write(at("latest"), b"a file").unwrap();
        assert_eq!(link(directory.path(), "latest", Path::new("a")).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        fs::remove_file(at("latest")).unwrap();
        fs::create_dir(at("latest")).unwrap();
        assert!(link(directory.path(), "latest", Path::new("a")).is_err());
        let left: Vec<_> = fs::read_dir(directory.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left.len(), 3, "{left:?}");
    }

    #[test]
    fn links_of_another_user_are_not_followed() {
        if !root() {
            return;
        }
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::create_dir(at("own")).unwrap();
        fs::write(at("own/secret"), b"kept").unwrap();
        for (target, link) in [("own/secret", "to-file"), ("own", "to-directory"), ("own/new", "to-nothing")] {
            symlink(target, at(link)).unwrap();
            lchown(at(link), Some(NOBODY), None).unwrap();
        }
        for path in ["to-file", "to-directory/secret", "to-directory/new", "to-nothing"] {
            let error = write(&at(path), b"gone").unwrap_err().to_string();
            assert!(error.contains("(uid 65534), and is not followed"), "{error}");
        }
        assert!(create_directories(&at("to-directory/new")).is_err());
        assert!(create_directories(&at("to-nothing")).is_err() && Directory::open(&at("to-directory")).is_err());
        assert_eq!(fs::read(at("own/secret")).unwrap(), b"kept");
        assert_eq!(fs::read_dir(at("own")).unwrap().count(), 1);
    }

    #[test]
    fn a_file_can_be_rewritten_as_soon_as_its_writer_is_dropped() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        let first = create(&path).unwrap();
        assert!(create(&path).is_err(), "it is being written");
        // As in a process that was just forked.
        let _copy = first.try_clone().unwrap();
        drop(first);
        create(&path).unwrap();
    }
}
