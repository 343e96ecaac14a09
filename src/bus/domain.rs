//! A run's domain: the directories and the name prefix under which everything it shares lives, so that two runs never meet
//! and no other user gets in.
//!
//! The domain's directory is private, and all that is believed is in it. What is mapped lies in shared memory: our own files
//! in a directory there that is private too, and `shared` in the domain's directory leads to it; the transport's beside it,
//! under a prefix that nobody knows before the first of them is made.
//!
//! Knows files and locks, and of the transport only which of its files it would leave open to everybody. The lock says whether
//! the run is alive; the kernel lets go of it when the launcher dies, however it dies. Must not touch a domain whose lock is
//! held, nor what another user has put beside it.

use crate::files::{PrivacyError, require_private, user, user_name};
use crate::system::{random_bits, remedy};
use rustix::fs::{FlockOperation, OFlags, flock, fstat, statvfs};
use rustix::io::Errno;
use std::ffi::OsStr;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Where the transport's shared memory appears as files.
pub const SHARED_MEMORY: &str = "/dev/shm";
/// What the names of a domain's files in [`SHARED_MEMORY`] begin with, before its id.
const PREFIX: &str = "corotate_";
/// What the transport's paths may not exceed, less what it appends: the directory of a node, and a file's name with the prefix.
const MAX_ROOT_LENGTH: usize = 112;
/// Letters of an identifier: 128 random bits, so that nobody guesses one.
const ID_LENGTH: usize = 32;
/// The file of iceoryx2 0.10 that it makes writable for everybody, its count of nodes, by the end of its name: the SHA-1 of
/// the count's type is in it. Made here, closed, it is taken as it is.
const NODE_COUNT: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// What is in it at first: the version 0.10.0 as 64 bits in the machine's order, then the count.
const NO_NODES: [u64; 2] = [10 << 16, 0];
/// So often a domain is given up in which another user has put something before us.
const DOMAINS_MAX: u32 = 3;
/// The link in a domain's directory to that of its own files in shared memory.
const OWN_SHARED: &str = "shared";
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
    /// A directory is not this user's alone.
    #[error(transparent)]
    Privacy(#[from] PrivacyError),
    /// Another user made what is the domain's to make, again and again.
    #[error("{} was there before this run could make it, in {DOMAINS_MAX} domains one after the other; remove it, or have its owner stopped", path.display())]
    Taken {
        /// What he made.
        path: PathBuf,
    },
    /// An identifier that can be guessed is none.
    #[error("the system gives no random numbers: {source}; a sandbox may forbid getrandom: allow it")]
    Random {
        /// The system's reason.
        source: io::Error,
    },
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
    /// The directory's path is too long for the transport's files.
    #[error("{} is longer than {MAX_ROOT_LENGTH} bytes, too long for the transport's files; set XDG_RUNTIME_DIR to a shorter one", path.display())]
    TooLong {
        /// The path.
        path: PathBuf,
    },
    /// The path is not a domain.
    #[error("{} is not the domain of a run; the domains of your runs are in {}", path.display(), base().display())]
    NotADomain {
        /// The path as given.
        path: PathBuf,
    },
}

/// The directory that is to hold this user's domains.
fn base() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|directory| !directory.is_empty()) {
        Some(directory) => PathBuf::from(directory).join("corotate"),
        None => PathBuf::from(format!("/tmp/corotate-{}", user())),
    }
}

/// The same, if it is there, without links.
///
/// # Errors
/// [`PrivacyError`]: there may be anything in it.
pub fn private_base() -> Result<Option<PathBuf>, PrivacyError> {
    match require_private(&base()) {
        Err(PrivacyError::System { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
        base => base.map(Some),
    }
}

impl OwnedDomain {
    /// Makes a new domain with room for `bytes` of shared memory, after removing those that dead runs of this user left
    /// behind.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn create(bytes: usize) -> Result<Self, DomainError> {
        let create = |path: &Path, source| DomainError::Create { path: path.to_owned(), source };
        remove_dead_domains()?;
        require_room(bytes as u64)?;
        let mut taken = 1;
        for _ in 0..ATTEMPTS {
            // Within the loop: another run that ends may remove the directory as long as it is empty.
            let base = base();
            DirBuilder::new().recursive(true).mode(0o700).create(&base).map_err(|error| create(&base, error))?;
            let Some(base) = private_base()? else { continue };
            let root = base.join(random_id()?);
            if root.as_os_str().len() > MAX_ROOT_LENGTH {
                return Err(DomainError::TooLong { path: root });
            }
            // The lock comes first: a domain without a lock that is held counts as dead.
            let Some(lock) = lock(&lock_path(&root), Lock::New)? else { continue };
            // Removed again if it cannot be completed.
            let owned = Self { domain: Domain { root }, _lock: lock };
            let root = owned.domain.root();
            DirBuilder::new().mode(0o700).create(root).map_err(|error| create(root, error))?;
            match owned.domain.make_shared() {
                Err(DomainError::Taken { .. }) if taken < DOMAINS_MAX => taken += 1,
                made => return made.map(|()| owned),
            }
        }
        Err(DomainError::Contended { path: base() })
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
    /// The domain at a directory that a launcher of this user made.
    ///
    /// # Errors
    /// [`DomainError::NotADomain`], [`DomainError::Privacy`].
    pub fn join(root: &Path) -> Result<Self, DomainError> {
        let named = root.file_name().is_some_and(is_id);
        if named && root.is_dir() && lock_path(root).is_file() {
            Ok(Self { root: require_private(root)? })
        } else {
            Err(DomainError::NotADomain { path: root.to_owned() })
        }
    }

    /// Makes what is the domain's in shared memory before anybody else does. The first file there tells the transport's prefix,
    /// so it is the only one of its files that has a name which can be known beforehand.
    fn make_shared(&self) -> Result<(), DomainError> {
        let failed = |path: &Path, source: io::Error| match source.kind() {
            io::ErrorKind::AlreadyExists => DomainError::Taken { path: path.to_owned() },
            _ => DomainError::Create { path: path.to_owned(), source },
        };
        let count = Path::new(SHARED_MEMORY).join(self.prefix() + NODE_COUNT);
        let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&count);
        made.and_then(|mut file| file.write_all(bytemuck::bytes_of(&NO_NODES)))
            .map_err(|error| failed(&count, error))?;
        let shared = Path::new(SHARED_MEMORY).join(format!("{}-{}", self.mark(), random_id()?));
        let link = self.root.join(OWN_SHARED);
        symlink(&shared, &link).map_err(|error| failed(&link, error))?;
        DirBuilder::new().mode(0o700).create(&shared).map_err(|error| failed(&shared, error))
    }

    /// Its directory, open to this user alone.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Whether its run has not been cleared away yet. What cannot be looked at is there.
    pub fn exists(&self) -> bool {
        lock_path(&self.root).try_exists().unwrap_or(true)
    }

    /// Removes what a process that left late has made anew in a domain that is gone.
    pub fn forget(&self) {
        if !self.exists() {
            self.remove();
        }
    }

    /// What the names of all its files in shared memory begin with.
    fn mark(&self) -> String {
        format!("{PREFIX}{}", self.root.file_name().unwrap_or_default().to_string_lossy())
    }

    /// What the names of the transport's files in shared memory begin with.
    pub fn prefix(&self) -> String {
        self.mark() + "_"
    }

    /// Where a file of ours lies in shared memory that goes with the domain.
    pub fn shared(&self, name: &str) -> PathBuf {
        self.root.join(OWN_SHARED).join(name)
    }

    /// What is the domain's in shared memory: the transport's files, and the directory of our own. What another user has put
    /// there under such a name is not.
    pub fn in_shared_memory(&self) -> impl Iterator<Item = PathBuf> {
        let (mark, user) = (self.mark(), user());
        let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
        entries
            .filter(move |entry| entry.file_name().to_string_lossy().starts_with(&mark))
            .filter(move |entry| entry.metadata().is_ok_and(|file| file.uid() == user))
            .map(|entry| entry.path())
    }

    /// Checks that whatever this process has mapped of the domain is its user's, so that no other can shorten it.
    ///
    /// # Errors
    /// [`PrivacyError::Foreign`].
    pub fn require_own_mappings(&self) -> Result<(), DomainError> {
        let begins = format!("{SHARED_MEMORY}/{}", self.prefix());
        let maps = fs::read_to_string("/proc/self/maps").unwrap_or_default();
        for path in maps.lines().filter_map(|line| line.find(&begins).map(|at| Path::new(&line[at..]))) {
            // What is gone cannot be looked at by its name, and went while it was ours: nobody else can remove it.
            if let Ok(file) = fs::symlink_metadata(path)
                && file.uid() != user()
            {
                return Err(PrivacyError::Foreign { path: path.to_owned(), owner: user_name(file.uid()) }.into());
            }
        }
        Ok(())
    }

    /// Removes every trace of the domain. What is gone already is no error.
    fn remove(&self) {
        self.in_shared_memory().for_each(|path| {
            let _ = fs::remove_file(&path).or_else(|_| fs::remove_dir_all(path));
        });
        let _ = fs::remove_dir_all(&self.root);
        // What could not be removed stays marked, for the next run of this user.
        let gone = matches!(self.root.try_exists(), Ok(false));
        if gone && self.in_shared_memory().next().is_none() {
            let _ = fs::remove_file(lock_path(&self.root));
        }
        // The directory of all domains goes with the last; it is not empty while another run lives.
        let _ = self.root.parent().map(fs::remove_dir);
    }
}

/// Removes the domains of this user whose launcher is dead, and tells which.
///
/// # Errors
/// [`PrivacyError`].
pub fn remove_dead_domains() -> Result<Vec<Domain>, PrivacyError> {
    Ok(private_base()?.map_or(Vec::new(), |base| remove_dead(&base)))
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
///
/// # Errors
/// [`DomainError::Privacy`].
pub fn domains() -> Result<Vec<Found>, DomainError> {
    Ok(private_base()?.map_or(Vec::new(), |base| found(&base)))
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
    let mut removed: Vec<Domain> = locks(base).filter_map(remove).collect();
    removed.extend(remade(base).inspect(Domain::remove));
    removed
}

/// Domains that are gone and were made anew by somebody who joined too late, and was killed: a launcher makes the lock before
/// the directory, and removes it after.
fn remade(base: &Path) -> impl Iterator<Item = Domain> {
    let entries = fs::read_dir(base).into_iter().flatten().flatten();
    let named = entries.map(|entry| entry.path()).filter(|root| root.file_name().is_some_and(is_id));
    named.filter(|root| matches!(lock_path(root).try_exists(), Ok(false))).map(|root| Domain { root })
}

fn is_id(name: &OsStr) -> bool {
    name.len() == ID_LENGTH && name.as_encoded_bytes().iter().all(u8::is_ascii_hexdigit)
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
    let mut options = OpenOptions::new();
    options.write(true).create_new(lock == Lock::New).mode(0o600).custom_flags(OFlags::NOFOLLOW.bits() as i32);
    let file = match options.open(path) {
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

fn random_id() -> Result<String, DomainError> {
    let bits = random_bits().map_err(|source| DomainError::Random { source })?;
    Ok(format!("{bits:0ID_LENGTH$x}"))
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
        let transports = Path::new(SHARED_MEMORY).join(format!("{}x", domain.prefix()));
        fs::write(&transports, b"x").unwrap();
        let own = fs::canonicalize(domain.shared("")).unwrap();
        assert!(own.starts_with(SHARED_MEMORY));
        assert_eq!(fs::metadata(&own).unwrap().mode() & 0o777, 0o700);
        fs::write(domain.shared("y"), b"y").unwrap();
        drop(owned);
        assert!(!transports.exists() && !own.exists() && !domain.root().exists() && !lock_path(domain.root()).exists());
        assert!(matches!(Domain::join(domain.root()), Err(DomainError::NotADomain { .. })));
    }

    #[test]
    fn the_dead_are_removed_and_the_living_are_not() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(format!("{name:0>ID_LENGTH$}"));
        let (dead, living, remade, other) = (at("dead"), at("1"), at("2"), base.path().join("other"));
        [&remade, &other].into_iter().for_each(|root| fs::create_dir(root).unwrap());
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
        assert!(!remade.exists() && other.exists());
    }
}
