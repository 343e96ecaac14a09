//! A run's domain: the directory and the name prefix under which everything it shares lives, so that two runs never meet.
//!
//! Knows files and locks, not the transport. The lock says whether the run is alive; the kernel lets go of it when the
//! launcher dies, however it dies. Must not touch a domain whose lock is held.

use crate::system::remedy;
use rustix::fs::{FlockOperation, flock, fstat, statvfs};
use rustix::io::Errno;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Where the transport's shared memory appears as files.
pub const SHARED_MEMORY: &str = "/dev/shm";
/// What the names of a domain's files in [`SHARED_MEMORY`] begin with, before its id.
const PREFIX: &str = "corotate_";
/// What the transport's socket paths may not exceed, less what it appends: see sockaddr_un.
const MAX_ROOT_LENGTH: usize = 48;
/// How often something is tried again that another process, or a signal, has come in the way of.
const ATTEMPTS: u32 = 100;

/// A domain that this process uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Domain {
    root: PathBuf,
}

/// A domain that this process owns; it is removed with everything in it when this is dropped.
#[derive(Debug)]
pub struct OwnedDomain {
    domain: Domain,
    _lock: File,
}

/// Why a domain could not be made or joined.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// A directory or file could not be made.
    #[error("cannot make {}: {source}; set XDG_RUNTIME_DIR to a directory that you may write", path.display())]
    Create {
        /// What could not be made.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A domain cannot be locked, so nobody could tell whether its run is alive.
    #[error("cannot lock {}: {source}; {}, or set XDG_RUNTIME_DIR to a directory of a local file system", path.display(), remedy(source))]
    Lock {
        /// The lock file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Every name that was tried was taken, or taken away.
    #[error("cannot make a domain in {} in {ATTEMPTS} attempts; end whatever removes files there", path.display())]
    Contended {
        /// The directory of all domains.
        path: PathBuf,
    },
    /// There is too little shared memory. Found out later it would kill whoever touches the missing page.
    #[error("/dev/shm has {} KiB free and the run may take {}; free some, or mount it larger", free >> 10, needed >> 10)]
    NoRoom {
        /// Bytes free.
        free: u64,
        /// Bytes that a run may take.
        needed: u64,
    },
    /// There are too few inodes. Found out later, files are left half made, and others wait for them.
    #[error("{} has room for {free} more files and the run may make {needed}; remove some, or mount it with more inodes (mount -o remount,nr_inodes=...)", path.display())]
    NoInodes {
        /// The directory.
        path: PathBuf,
        /// Files that may yet be made.
        free: u64,
        /// Files that a run may make.
        needed: u64,
    },
    /// The directory's path is too long for the transport's sockets.
    #[error("{} is longer than {MAX_ROOT_LENGTH} bytes, too long for socket names; set XDG_RUNTIME_DIR to a shorter one", path.display())]
    TooLong {
        /// The path.
        path: PathBuf,
    },
    /// The path is not a domain.
    #[error("{} is not the domain of a run; `corotate run` prints it", path.display())]
    NotADomain {
        /// The path as given.
        path: PathBuf,
    },
}

/// The directory that holds this user's domains.
fn base() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|directory| !directory.is_empty()) {
        Some(directory) => PathBuf::from(directory).join("corotate"),
        None => PathBuf::from(format!("/tmp/corotate-{}", rustix::process::getuid().as_raw())),
    }
}

impl OwnedDomain {
    /// Makes a new domain with room for `bytes` of shared memory, after removing those that dead runs of this user left
    /// behind.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn create(bytes: usize) -> Result<Self, DomainError> {
        let base = base();
        let create = |path: &Path, source| DomainError::Create { path: path.to_owned(), source };
        remove_dead(&base);
        require_room(bytes as u64)?;
        for _ in 0..ATTEMPTS {
            // Within the loop: another run that ends may remove the directory as long as it is empty.
            DirBuilder::new().recursive(true).mode(0o700).create(&base).map_err(|error| create(&base, error))?;
            let root = base.join(random_id());
            if root.as_os_str().len() > MAX_ROOT_LENGTH {
                return Err(DomainError::TooLong { path: root });
            }
            // The lock comes first: a domain without a lock that is held counts as dead.
            let Some(lock) = lock(&lock_path(&root), Lock::New)? else { continue };
            // Removed again if it cannot be completed.
            let owned = Self { domain: Domain { root }, _lock: lock };
            let root = owned.domain.root();
            DirBuilder::new().mode(0o700).create(root).map_err(|error| create(root, error))?;
            return Ok(owned);
        }
        Err(DomainError::Contended { path: base })
    }

    /// The domain, to be used.
    pub fn domain(&self) -> &Domain {
        &self.domain
    }
}

impl Drop for OwnedDomain {
    fn drop(&mut self) {
        self.domain.remove();
    }
}

impl Domain {
    /// The domain at a directory that a launcher made.
    ///
    /// # Errors
    /// [`DomainError::NotADomain`].
    pub fn join(root: &Path) -> Result<Self, DomainError> {
        let named = root.file_name().is_some_and(|name| name.len() == 8);
        if named && root.is_dir() && lock_path(root).is_file() {
            Ok(Self { root: root.to_owned() })
        } else {
            Err(DomainError::NotADomain { path: root.to_owned() })
        }
    }

    /// Its directory, open to this user alone.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Whether its run has not been cleared away yet.
    pub fn exists(&self) -> bool {
        lock_path(&self.root).is_file()
    }

    /// Removes what a process that left late has made anew in a domain that is gone.
    pub fn forget(&self) {
        if !self.exists() {
            self.remove();
        }
    }

    /// What the names of its files in shared memory begin with.
    pub fn prefix(&self) -> String {
        format!("{PREFIX}{}_", self.root.file_name().unwrap_or_default().to_string_lossy())
    }

    /// Where a file lies in shared memory that goes with the domain.
    pub fn shared(&self, name: &str) -> PathBuf {
        Path::new(SHARED_MEMORY).join(self.prefix() + name)
    }

    /// Takes from other users what the transport has left open to them in shared memory so far.
    ///
    /// iceoryx2 0.10 makes one file, its count of nodes, writable for everybody. It is there once somebody has entered.
    ///
    /// # Errors
    /// [`DomainError::Create`].
    pub fn seal(&self) -> Result<(), DomainError> {
        for path in self.in_shared_memory() {
            let private = fs::Permissions::from_mode(0o600);
            fs::set_permissions(&path, private).map_err(|source| DomainError::Create { path, source })?;
        }
        Ok(())
    }

    /// The domain's files in shared memory.
    pub(super) fn in_shared_memory(&self) -> impl Iterator<Item = PathBuf> {
        let prefix = self.prefix();
        let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
        entries.filter(move |entry| entry.file_name().to_string_lossy().starts_with(&prefix)).map(|entry| entry.path())
    }

    /// Removes every trace of the domain. What is gone already is no error.
    fn remove(&self) {
        self.in_shared_memory().for_each(|path| drop(fs::remove_file(path)));
        let _ = fs::remove_dir_all(&self.root);
        // What could not be removed stays marked, for the next run of this user.
        if !self.root.exists() && self.in_shared_memory().next().is_none() {
            let _ = fs::remove_file(lock_path(&self.root));
        }
        // The directory of all domains goes with the last; it is not empty while another run lives.
        let _ = self.root.parent().map(fs::remove_dir);
    }
}

/// Removes the domains of this user whose launcher is dead, and tells which.
pub fn remove_dead_domains() -> Vec<Domain> {
    remove_dead(&base())
}

/// A domain that was found, of a run or of what is left of one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Its directory.
    pub root: PathBuf,
    /// Whether its launcher is alive.
    pub alive: bool,
    /// When it was made, as far as the file system tells.
    pub made: Option<SystemTime>,
}

/// The domains of this user, the newest first.
pub fn domains() -> Vec<Found> {
    found(&base())
}

/// The domain of the newest run of this user that is under way.
pub fn newest_run() -> Option<PathBuf> {
    domains().into_iter().find(|found| found.alive).map(|found| found.root)
}

fn found(base: &Path) -> Vec<Found> {
    let find = |path: PathBuf| {
        let made = fs::metadata(&path).and_then(|lock| lock.modified()).ok();
        // Whoever holds the lock is alive; one that is ours now was nobody's, and is let go of at once.
        let alive = !matches!(lock(&path, Lock::Existing), Ok(Some(_)));
        Found { root: path.with_extension(""), alive, made }
    };
    let mut found: Vec<Found> = locks(base).map(find).collect();
    found.sort_by_key(|found| std::cmp::Reverse(found.made));
    found
}

/// The lock files of all domains.
fn locks(base: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(base).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|extension| extension == "lock"))
}

fn require_room(needed: u64) -> Result<(), DomainError> {
    // A system that does not tell how much is left is not refused for it.
    let free = statvfs(SHARED_MEMORY).map_or(u64::MAX, |room| room.f_bavail.saturating_mul(room.f_frsize));
    if free < needed { Err(DomainError::NoRoom { free, needed }) } else { Ok(()) }
}

/// Checks that so many files can be made in shared memory, and as many beside the domains.
///
/// # Errors
/// [`DomainError::NoInodes`].
pub fn require_files(needed: u64) -> Result<(), DomainError> {
    let base = base();
    // The directory of all domains may not be there yet.
    let existing = base.ancestors().find(|path| path.is_dir()).unwrap_or(Path::new("/"));
    for path in [Path::new(SHARED_MEMORY), existing] {
        // A system that does not tell how many there are, or makes them as it needs them, is not refused for it.
        let free = statvfs(path).ok().filter(|room| room.f_files > 0).map_or(u64::MAX, |room| room.f_favail);
        if free < needed {
            return Err(DomainError::NoInodes { path: path.to_owned(), free, needed });
        }
    }
    Ok(())
}

fn remove_dead(base: &Path) -> Vec<Domain> {
    let remove = |path: PathBuf| {
        let _held = lock(&path, Lock::Existing).ok().flatten()?;
        let domain = Domain { root: path.with_extension("") };
        domain.remove();
        Some(domain)
    };
    locks(base).filter_map(remove).collect()
}

fn lock_path(root: &Path) -> PathBuf {
    root.with_extension("lock")
}

/// Whether a lock is to be made or taken over.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Lock {
    New,
    Existing,
}

/// Takes a lock file; `None` if another process holds it, made it, or took it away meanwhile.
fn lock(path: &Path, lock: Lock) -> Result<Option<File>, DomainError> {
    let file = match OpenOptions::new().write(true).create_new(lock == Lock::New).mode(0o600).open(path) {
        Err(error) if matches!(error.kind(), io::ErrorKind::AlreadyExists | io::ErrorKind::NotFound) => {
            return Ok(None);
        }
        other => other.map_err(|source| DomainError::Create { path: path.to_owned(), source })?,
    };
    match flock_now(&file) {
        Ok(()) => {}
        Err(Errno::WOULDBLOCK) => return Ok(None),
        Err(error) => {
            if lock == Lock::New {
                let _ = fs::remove_file(path);
            }
            return Err(DomainError::Lock { path: path.to_owned(), source: error.into() });
        }
    }
    // Whoever cleans up takes the lock, removes the file, lets go: a lock on a removed file protects nothing.
    let same = fs::metadata(path).is_ok_and(|at_path| fstat(&file).is_ok_and(|held| held.st_ino == at_path.ino()));
    Ok(same.then_some(file))
}

/// Locks a file, or tells at once that another process has. A signal is no reason.
fn flock_now(file: &File) -> Result<(), Errno> {
    let mut locked = Err(Errno::INTR);
    for _ in 0..ATTEMPTS {
        locked = flock(file, FlockOperation::NonBlockingLockExclusive);
        if locked != Err(Errno::INTR) {
            break;
        }
    }
    locked
}

fn random_id() -> String {
    use std::hash::{BuildHasher, Hasher};
    // The standard library seeds every RandomState from the system's randomness.
    let random = std::collections::hash_map::RandomState::new().build_hasher().finish();
    format!("{:08x}", random as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_domain_is_private_and_goes_without_a_trace() {
        let owned = OwnedDomain::create(0).unwrap();
        let domain = owned.domain().clone();
        assert_eq!(fs::metadata(domain.root()).unwrap().mode() & 0o777, 0o700);
        assert_eq!(Domain::join(domain.root()).unwrap(), domain);
        let shared = Path::new(SHARED_MEMORY).join(format!("{}x", domain.prefix()));
        fs::write(&shared, b"x").unwrap();
        drop(owned);
        assert!(!shared.exists() && !domain.root().exists() && !lock_path(domain.root()).exists());
        assert!(matches!(Domain::join(domain.root()), Err(DomainError::NotADomain { .. })));
    }

    #[test]
    fn what_could_not_be_removed_stays_marked() {
        let owned = OwnedDomain::create(0).unwrap();
        let domain = owned.domain().clone();
        // What `remove_file` refuses.
        let stubborn = domain.shared("x");
        fs::create_dir(&stubborn).unwrap();
        drop(owned);
        assert!(domain.exists() && !domain.root().exists());
        fs::remove_dir(&stubborn).unwrap();
        remove_dead_domains();
        assert!(!domain.exists());
    }

    #[test]
    fn the_dead_are_removed_and_the_living_are_not() {
        let base = tempfile::tempdir().unwrap();
        let (dead, living) = (base.path().join("0000dead"), base.path().join("00000001"));
        let mut held = None;
        for root in [&dead, &living] {
            fs::create_dir(root).unwrap();
            held = lock(&lock_path(root), Lock::New).unwrap();
        }
        let alive =
            |root: &PathBuf| found(base.path()).into_iter().find(|found| found.root == *root).map(|one| one.alive);
        assert_eq!((alive(&dead), alive(&living)), (Some(false), Some(true)));
        remove_dead(base.path());
        assert_eq!((alive(&dead), alive(&living)), (None, Some(true)));
        assert!(!dead.exists() && !lock_path(&dead).exists());
        assert!(living.exists() && held.is_some());
    }
}
