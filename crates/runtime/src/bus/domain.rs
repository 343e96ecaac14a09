//! The domain of a run: the directories and the name prefix of everything that the run shares. Two runs never meet in
//! it, and no other user can enter.
//!
//! The domain's directory is private, and only its content is trusted. Mapped files lie in shared memory: our own in a
//! private directory there, to which the link `shared` in the domain's directory leads; the transport's beside it,
//! under a prefix that stays unknown until its first file exists.
//!
//! Knows files and locks, and which file the transport would leave writable for all users. A held lock means that the
//! run is alive; the kernel releases it when the launcher dies. The launcher also locks its directory in shared memory,
//! because that lock is visible where the domain's directory is not, for example outside a container. Must not touch a
//! domain whose lock is held, nor files of other users.

use crate::files::{self, PrivacyError, require_private, user, user_name};
use crate::system::{random_bits, remedy};
use rustix::fs::{OFlags, statvfs};
use std::ffi::OsStr;
use std::fs::{self, DirBuilder, File, Metadata, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// The directory of the transport's shared memory.
pub const SHARED_MEMORY: &str = "/dev/shm";
/// The prefix of a domain's file names in [`SHARED_MEMORY`], before its ID.
const PREFIX: &str = "corotate_";
/// Longest allowed path of a domain: the transport appends a node's directory and a file name with the prefix.
const MAX_ROOT_LENGTH: usize = 112;
/// Length of a domain ID in hexadecimal digits: 128 random bits, so that it is unguessable.
const ID_LENGTH: usize = 32;
/// Name of the file in which iceoryx2 0.10 counts its nodes, with the SHA-1 of the count's type. The transport would
/// create it writable for all users; a private one that exists is used instead.
const NODE_COUNT: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// Initial content of that file: version 0.10.0 as 64 bits in native order, then the count.
const NO_NODES: [u64; 2] = [10 << 16, 0];
/// Number of domains that are tried if another user has created a file of the domain first.
const DOMAINS_MAX: u32 = 3;
/// The link in a domain's directory to its own directory in shared memory.
const OWN_SHARED: &str = "shared";
/// The link in a domain's directory in shared memory to the domain's directory.
const OWN_ROOT: &str = "root";
/// Age from which files in shared memory without a locked directory count as abandoned. A launcher creates its
/// directory microseconds after its first file.
const BEGUN: Duration = Duration::from_secs(60);
/// Number of attempts when another process or a signal interferes.
const ATTEMPTS: u32 = 100;

/// A domain in use by this process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Domain {
    root: PathBuf,
}

/// A domain owned by this process. Dropping it removes the domain with its content.
#[derive(Debug)]
pub struct OwnedDomain {
    domain: Domain,
    _lock: File,
    /// The lock on its directory in shared memory.
    _shared: Option<File>,
}

/// A domain could not be created, joined or found.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum DomainError {
    /// A directory is not private to this user.
    #[error(transparent)]
    #[strum(transparent)]
    Privacy(#[from] PrivacyError),
    /// Another user repeatedly created a file of the domain first.
    #[error("{} exists already: another user created it first, in {DOMAINS_MAX} domains in succession; remove it, or stop that user's program", path.display())]
    #[strum(serialize = "domain-taken")]
    Taken {
        /// The file of the other user.
        path: PathBuf,
    },
    /// Domain identifiers must be unguessable.
    #[error("the system gives no random numbers: {source}; a sandbox may forbid getrandom: allow it")]
    #[strum(serialize = "no-random-numbers")]
    Random {
        /// The system's reason.
        source: io::Error,
    },
    /// A directory or file could not be made.
    #[error("cannot make {}: {source}; {}", path.display(), remedy_at(path, source))]
    #[strum(serialize = "cannot-create")]
    Create {
        /// The path.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A domain cannot be locked, so other processes could not tell whether its run is alive.
    #[error("cannot lock {}: {source}; {}, or set XDG_RUNTIME_DIR to a directory of a local file system", path.display(), remedy(source))]
    #[strum(serialize = "cannot-lock")]
    Lock {
        /// The lock file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Every attempt to create a domain met another process.
    #[error("cannot make a domain in {} in {ATTEMPTS} attempts; stop the program that removes files there", path.display())]
    #[strum(serialize = "domain-contended")]
    Contended {
        /// The directory of all domains.
        path: PathBuf,
    },
    /// Too little shared memory. Later a missing page would kill the process that touches it.
    #[error("/dev/shm has {} KiB free and the run may take {}; free some, or mount it larger", free >> 10, needed >> 10)]
    #[strum(serialize = "no-shared-memory")]
    NoRoom {
        /// Bytes free.
        free: u64,
        /// Bytes that a run may take.
        needed: u64,
    },
    /// Too few inodes. Later this would leave half-made files that other processes wait for.
    #[error("{} has room for {free} more files and the run may make {needed}; remove some, or mount it with more inodes (mount -o remount,nr_inodes=...)", path.display())]
    NoInodes {
        /// The directory.
        path: PathBuf,
        /// Number of files that can still be created.
        free: u64,
        /// Number of files that a run may create.
        needed: u64,
    },
    /// The directory's path is too long for the transport's files.
    #[error("{} is longer than {MAX_ROOT_LENGTH} bytes, too long for the transport's files; set XDG_RUNTIME_DIR to a shorter one", path.display())]
    #[strum(serialize = "path-too-long")]
    TooLong {
        /// The path.
        path: PathBuf,
    },
    /// No run is in progress.
    #[error("no run of this user is under way; start one with `corotate run`, or name its domain's directory")]
    NoRun,
    /// The path names the results of a run that is over.
    #[error("{} has the results of a run that is over; `corotate report {}` shows it", path.display(), path.display())]
    #[strum(serialize = "run-over")]
    Over {
        /// The path as given.
        path: PathBuf,
    },
    /// The path is not a domain.
    #[error("{} is not the domain of a run that is under way, nor where its results go; the domains of your runs are in {}", path.display(), base().display())]
    NotADomain {
        /// The path as given.
        path: PathBuf,
    },
}

/// Returns the remedy for an error at a path in shared memory or in the directory of all domains.
fn remedy_at(path: &Path, error: &io::Error) -> String {
    if !path.starts_with(SHARED_MEMORY) {
        return format!("{}, or set XDG_RUNTIME_DIR to another directory", remedy(error));
    }
    match error.raw_os_error() {
        Some(libc::EROFS) => format!("`mount -o remount,rw {SHARED_MEMORY}` makes it writable"),
        Some(libc::EACCES | libc::EPERM) => format!("let this user write there: `chmod 1777 {SHARED_MEMORY}`"),
        Some(libc::ENOENT) => format!("mount a tmpfs at {SHARED_MEMORY}"),
        Some(libc::ENOSPC) => format!("remove files there, or `mount -o remount,size=2g {SHARED_MEMORY}`"),
        _ => remedy(error).to_owned(),
    }
}

/// Returns the directory for this user's domains.
fn base() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|directory| !directory.is_empty()) {
        Some(directory) => PathBuf::from(directory).join("corotate"),
        None => PathBuf::from(format!("/tmp/corotate-{}", user())),
    }
}

/// Returns that directory without symbolic links, if it exists.
///
/// # Errors
/// [`PrivacyError`]: its content must not be trusted.
pub fn private_base() -> Result<Option<PathBuf>, PrivacyError> {
    match require_private(&base()) {
        Err(PrivacyError::System { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
        base => base.map(Some),
    }
}

impl OwnedDomain {
    /// Creates a domain with room for `bytes` of shared memory, after removing the domains of this user's dead runs.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn create(bytes: usize) -> Result<Self, DomainError> {
        let create = |path: &Path, source| DomainError::Create { path: path.to_owned(), source };
        remove_dead_domains()?;
        require_room(bytes as u64)?;
        let mut taken = 1;
        for _ in 0..ATTEMPTS {
            // Inside the loop: a run that ends may remove the directory while it is empty.
            let base = base();
            DirBuilder::new().recursive(true).mode(0o700).create(&base).map_err(|error| create(&base, error))?;
            let Some(base) = private_base()? else { continue };
            let root = base.join(random_id()?);
            if root.as_os_str().len() > MAX_ROOT_LENGTH {
                return Err(DomainError::TooLong { path: root });
            }
            // The lock comes first: a domain without a held lock counts as dead.
            let Some(lock) = lock(&lock_path(&root), LockMode::New)? else { continue };
            // Dropped, and so removed, if the domain cannot be completed.
            let mut owned = Self { domain: Domain { root }, _lock: lock, _shared: None };
            let root = owned.domain.root();
            DirBuilder::new().mode(0o700).create(root).map_err(|error| create(root, error))?;
            match owned.domain.make_shared() {
                Err(DomainError::Taken { .. }) if taken < DOMAINS_MAX => taken += 1,
                made => {
                    owned._shared = made?;
                    return Ok(owned);
                }
            }
        }
        Err(DomainError::Contended { path: base() })
    }

    /// Returns the domain.
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
    /// Joins the domain in a directory that a launcher of this user created.
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

    /// Creates the domain's files in shared memory before another user can. The first file reveals the transport's
    /// prefix, so it is the only one whose name is predictable. Returns the lock on the domain's directory in shared
    /// memory; `None` if the file system has no locks.
    fn make_shared(&self) -> Result<Option<File>, DomainError> {
        let failed = |path: &Path, source: io::Error| match source.kind() {
            io::ErrorKind::AlreadyExists => DomainError::Taken { path: path.to_owned() },
            _ => DomainError::Create { path: path.to_owned(), source },
        };
        let count = Path::new(SHARED_MEMORY).join(self.prefix() + NODE_COUNT);
        let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&count);
        made.and_then(|mut file| file.write_all(bytemuck::bytes_of(&NO_NODES)))
            .map_err(|error| failed(&count, error))?;
        let shared = Path::new(SHARED_MEMORY).join(format!("{}-{}", self.name_stem(), random_id()?));
        let link = self.root.join(OWN_SHARED);
        symlink(&shared, &link).map_err(|error| failed(&link, error))?;
        DirBuilder::new().mode(0o700).create(&shared).map_err(|error| failed(&shared, error))?;
        // Until it is locked, another process may remove it as abandoned.
        let taken = || DomainError::Taken { path: shared.clone() };
        let directory = open_directory(&shared).map_err(|_| taken())?;
        let lock = match files::lock(&directory, &shared) {
            Ok(true) => Some(directory),
            Ok(false) => return Err(taken()),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Err(taken()),
            Err(_) => None,
        };
        let root = shared.join(OWN_ROOT);
        symlink(&self.root, &root).map_err(|error| failed(&root, error))?;
        Ok(lock)
    }

    /// Returns the domain's directory, which is private to this user.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns true until the domain has been removed. A domain that cannot be examined counts as existing.
    pub fn exists(&self) -> bool {
        lock_path(&self.root).try_exists().unwrap_or(true)
    }

    /// Removes files that a late process has created in a domain that is already removed.
    pub fn remove_if_over(&self) {
        if !self.exists() {
            self.remove();
        }
    }

    /// Returns the prefix of all its file names in shared memory.
    fn name_stem(&self) -> String {
        format!("{PREFIX}{}", self.root.file_name().unwrap_or_default().to_string_lossy())
    }

    /// Returns the prefix of the transport's file names in shared memory.
    pub fn prefix(&self) -> String {
        self.name_stem() + "_"
    }

    /// Returns the path of one of our files in the domain's shared memory.
    pub fn shared(&self, name: &str) -> PathBuf {
        self.root.join(OWN_SHARED).join(name)
    }

    /// Returns the domain's entries in shared memory: the transport's files and our own directory. Entries of other
    /// users with such names are left out.
    pub fn shared_memory_files(&self) -> impl Iterator<Item = PathBuf> {
        let (stem, user) = (self.name_stem(), user());
        let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
        entries
            .filter(move |entry| entry.file_name().to_string_lossy().starts_with(&stem))
            .filter(move |entry| entry.metadata().is_ok_and(|file| file.uid() == user))
            .map(|entry| entry.path())
    }

    /// Checks that every mapped file of the domain belongs to this user, so that no other user can shorten it.
    ///
    /// # Errors
    /// [`PrivacyError::Foreign`].
    pub fn require_own_mappings(&self) -> Result<(), DomainError> {
        let begins = format!("{SHARED_MEMORY}/{}", self.prefix());
        let maps = fs::read_to_string("/proc/self/maps").unwrap_or_default();
        for path in maps.lines().filter_map(|line| line.find(&begins).map(|at| Path::new(&line[at..]))) {
            // A file that has vanished was ours: no other user can remove it.
            if let Ok(file) = fs::symlink_metadata(path)
                && file.uid() != user()
            {
                return Err(PrivacyError::Foreign { path: path.to_owned(), owner: user_name(file.uid()) }.into());
            }
        }
        Ok(())
    }

    /// Removes the domain's files in shared memory.
    fn remove_shared(&self) {
        self.shared_memory_files().for_each(|path| {
            let _ = fs::remove_file(&path).or_else(|_| fs::remove_dir_all(path));
        });
    }

    /// Removes every file of the domain. Vanished files are no error.
    fn remove(&self) {
        self.remove_shared();
        let _ = fs::remove_dir_all(&self.root);
        // If something could not be removed, the lock file stays as a mark for this user's next run.
        let gone = matches!(self.root.try_exists(), Ok(false));
        if gone && self.shared_memory_files().next().is_none() {
            let _ = fs::remove_file(lock_path(&self.root));
        }
        // Removes the directory of all domains with the last domain; it is not empty while another run exists.
        let _ = self.root.parent().map(fs::remove_dir);
    }
}

/// Removes the domains of this user's dead runs and returns them.
///
/// # Errors
/// [`PrivacyError`].
pub fn remove_dead_domains() -> Result<Vec<Domain>, PrivacyError> {
    Ok(private_base()?.map_or(Vec::new(), |base| remove_dead(&base)))
}

/// Files of dead runs in shared memory without a domain directory, for example of a container.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AbandonedFiles {
    /// Number of runs.
    pub runs: usize,
    /// Number of files.
    pub files: usize,
    /// Size of the files, bytes.
    pub bytes: u64,
}

/// Finds the files of this user's dead runs in shared memory whose domain directories are gone; removes them if `clean`
/// is true.
pub fn scan_abandoned(clean: bool) -> AbandonedFiles {
    let mut ids: Vec<String> = entries(Path::new(SHARED_MEMORY)).filter_map(|path| id_of(&path)).collect();
    ids.sort();
    ids.dedup();
    let mut all = AbandonedFiles::default();
    for id in ids {
        let domain = Domain { root: base().join(id) };
        // Held until the removal is complete: a launcher that is starting does not get these locks and retries.
        let Some(_locks) = domain.lock_abandoned() else { continue };
        for path in domain.shared_memory_files() {
            let within = entries(&path).chain([path]).filter_map(|path| fs::symlink_metadata(path).ok());
            for file in within.filter(Metadata::is_file) {
                all.files += 1;
                all.bytes += file.len();
            }
        }
        all.runs += 1;
        if clean {
            domain.remove_shared();
        }
    }
    all
}

/// Returns the domain ID in the name of a path in shared memory.
fn id_of(path: &Path) -> Option<String> {
    let (id, rest) = path.file_name()?.to_str()?.strip_prefix(PREFIX)?.split_at_checked(ID_LENGTH)?;
    (is_id(OsStr::new(id)) && rest.starts_with(['_', '-'])).then(|| id.to_owned())
}

fn entries(directory: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path())
}

/// Opens a directory that is not a symbolic link.
fn open_directory(path: &Path) -> io::Result<File> {
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::NONBLOCK;
    OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path)
}

impl Domain {
    /// Returns the locks of a domain whose launcher is dead and whose directory is gone; `None` if either may exist.
    ///
    /// The launcher locks the directory in shared memory, and every role its ledger there. Such a lock is visible from
    /// every PID namespace, and the kernel releases it when its holder dies.
    fn lock_abandoned(&self) -> Option<Vec<File>> {
        let is_there = |root: &Path| !matches!(lock_path(root).try_exists(), Ok(false));
        if is_there(&self.root) {
            return None;
        }
        let mut locks = Vec::new();
        for path in self.shared_memory_files() {
            let about = fs::symlink_metadata(&path).ok()?;
            if !about.is_dir() {
                continue;
            }
            match fs::read_link(path.join(OWN_ROOT)) {
                Ok(root) if is_there(&root) => return None,
                // An older launcher holds no lock until its roles do.
                Err(_) if !about.modified().ok()?.elapsed().is_ok_and(|age| age > BEGUN) => return None,
                _ => {}
            }
            let directory = open_directory(&path).ok()?;
            if !files::lock(&directory, &path).ok()? {
                return None;
            }
            locks.push(directory);
            for path in entries(&path).filter(|path| path.file_name().is_some_and(|name| name != OWN_ROOT)) {
                let file = files::open_with(&path, OpenOptions::new().read(true), OFlags::NOFOLLOW).ok()?;
                if !files::lock(&file, &path).ok()? {
                    return None;
                }
                locks.push(file);
            }
        }
        if locks.is_empty() {
            let age = |path: PathBuf| fs::symlink_metadata(path).ok()?.modified().ok()?.elapsed().ok();
            return self.shared_memory_files().all(|path| age(path).is_some_and(|age| age > BEGUN)).then_some(locks);
        }
        Some(locks)
    }
}

/// A domain of a living or dead run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDomain {
    /// The domain's directory.
    pub root: PathBuf,
    /// True if the launcher is alive.
    pub alive: bool,
    /// Creation time, if the file system provides it.
    pub made: Option<SystemTime>,
}

/// Returns the domains of this user, newest first.
///
/// # Errors
/// [`DomainError::Privacy`].
pub fn domains() -> Result<Vec<FoundDomain>, DomainError> {
    Ok(private_base()?.map_or(Vec::new(), |base| find_domains(&base)))
}

fn find_domains(base: &Path) -> Vec<FoundDomain> {
    let find = |path: PathBuf| {
        let made = fs::metadata(&path).and_then(|lock| lock.modified()).ok();
        // A held lock means that the launcher is alive. A lock taken here was free, and is released at once.
        let alive = !matches!(lock(&path, LockMode::Existing), Ok(Some(_)));
        FoundDomain { root: path.with_extension(""), alive, made }
    };
    let mut found: Vec<FoundDomain> = locks(base).map(find).collect();
    found.sort_by_key(|found| std::cmp::Reverse(found.made));
    found
}

/// Returns the lock files of all domains: regular files with a matching name.
fn locks(base: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(base).into_iter().flatten().flatten();
    let regular = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()));
    regular.map(|entry| entry.path()).filter(|path| {
        path.extension().is_some_and(|extension| extension == "lock") && path.file_stem().is_some_and(is_id)
    })
}

fn require_room(needed: u64) -> Result<(), DomainError> {
    // If the system does not report free space, the run is not refused.
    let free = statvfs(SHARED_MEMORY).map_or(u64::MAX, |room| room.f_bavail.saturating_mul(room.f_frsize));
    if free < needed { Err(DomainError::NoRoom { free, needed }) } else { Ok(()) }
}

/// Checks that this number of files can be created in shared memory and in the directory of all domains.
///
/// # Errors
/// [`DomainError::NoInodes`].
pub fn require_files(needed: u64) -> Result<(), DomainError> {
    let base = base();
    // The directory of all domains may not exist yet.
    let existing = base.ancestors().find(|path| path.is_dir()).unwrap_or(Path::new("/"));
    for path in [Path::new(SHARED_MEMORY), existing] {
        // If the file system does not report inodes or creates them on demand, the run is not refused.
        let free = statvfs(path).ok().filter(|room| room.f_files > 0).map_or(u64::MAX, |room| room.f_favail);
        if free < needed {
            return Err(DomainError::NoInodes { path: path.to_owned(), free, needed });
        }
    }
    Ok(())
}

fn remove_dead(base: &Path) -> Vec<Domain> {
    let remove = |path: PathBuf| {
        let _held = lock(&path, LockMode::Existing).ok().flatten()?;
        let domain = Domain { root: path.with_extension("") };
        domain.remove();
        Some(domain)
    };
    let mut removed: Vec<Domain> = locks(base).filter_map(remove).collect();
    removed.extend(recreated(base).inspect(Domain::remove));
    removed
}

/// Returns removed domains that a late process has created again before it was killed: a launcher creates the lock
/// before the directory and removes it after.
fn recreated(base: &Path) -> impl Iterator<Item = Domain> {
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

/// Creation of a lock file, or use of an existing one.
#[derive(Clone, Copy, PartialEq, Eq)]
enum LockMode {
    New,
    Existing,
}

/// Locks a lock file; `None` if another process holds, created or removed it.
fn lock(path: &Path, lock: LockMode) -> Result<Option<File>, DomainError> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(lock == LockMode::New).mode(0o600);
    let file = match files::open_with(path, &mut options, OFlags::NOFOLLOW) {
        Err(error) if matches!(error.kind(), io::ErrorKind::AlreadyExists | io::ErrorKind::NotFound) => {
            return Ok(None);
        }
        other => other.map_err(|source| DomainError::Create { path: path.to_owned(), source })?,
    };
    match files::lock(&file, path) {
        Ok(named) => Ok(named.then_some(file)),
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(None),
        Err(source) => {
            if lock == LockMode::New {
                let _ = fs::remove_file(path);
            }
            Err(DomainError::Lock { path: path.to_owned(), source })
        }
    }
}

fn random_id() -> Result<String, DomainError> {
    let bits = random_bits().map_err(|source| DomainError::Random { source })?;
    Ok(format!("{bits:0ID_LENGTH$x}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_domain_is_private_and_is_removed_completely() {
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

    /// As after a killed container whose base directory is gone: only files and released locks remain.
    #[test]
    fn abandoned_files_in_shared_memory_are_found_without_a_domain_directory() {
        let elsewhere = tempfile::tempdir().unwrap();
        let domain = Domain { root: elsewhere.path().join(random_id().unwrap()) };
        let left = || domain.shared_memory_files().count();
        let lock = domain.make_shared().unwrap_err();
        assert!(matches!(lock, DomainError::Create { .. }), "its directory is not there yet: {lock}");
        domain.remove_shared();
        fs::create_dir(domain.root()).unwrap();
        let lock = domain.make_shared().unwrap();
        let record = fs::canonicalize(domain.shared("")).unwrap().join("record");
        fs::write(&record, b"x").unwrap();
        assert!(domain.lock_abandoned().is_none(), "the launcher lives");
        drop(lock);
        let role = File::open(&record).unwrap();
        assert!(files::lock(&role, &record).unwrap());
        assert!(domain.lock_abandoned().is_none(), "a role lives");
        drop(role);
        fs::write(lock_path(domain.root()), b"").unwrap();
        assert!(domain.lock_abandoned().is_none(), "its base is there");
        fs::remove_file(lock_path(domain.root())).unwrap();
        let found = scan_abandoned(false);
        assert!(found.runs >= 1 && found.files >= 2 && found.bytes > 0, "{found:?}");
        assert_eq!(left(), 2);
        scan_abandoned(true);
        assert_eq!(left(), 0);
        // Without a directory in shared memory the file may belong to a starting launcher.
        let young = Path::new(SHARED_MEMORY).join(format!("{}x", domain.prefix()));
        fs::write(&young, b"x").unwrap();
        assert!(domain.lock_abandoned().is_none());
        let old = SystemTime::now() - 2 * BEGUN;
        File::options().write(true).open(&young).unwrap().set_modified(old).unwrap();
        assert!(domain.lock_abandoned().is_some());
        domain.remove_shared();
    }

    #[test]
    fn only_regular_files_are_locks() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(format!("{name:0>ID_LENGTH$}.lock"));
        rustix::fs::mkfifoat(rustix::fs::CWD, at("1"), rustix::fs::Mode::RWXU).unwrap();
        fs::create_dir(at("2")).unwrap();
        symlink("/dev/zero", at("3")).unwrap();
        let _socket = std::os::unix::net::UnixListener::bind(at("4")).unwrap();
        assert!(find_domains(base.path()).is_empty() && remove_dead(base.path()).is_empty());
        for name in ["1", "2", "3", "4"] {
            assert!(!matches!(lock(&at(name), LockMode::Existing), Ok(Some(_))), "{name}");
            assert!(fs::symlink_metadata(at(name)).is_ok());
        }
    }

    #[test]
    fn only_domains_of_dead_runs_are_removed() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(format!("{name:0>ID_LENGTH$}"));
        let (dead, living, recreated, unrelated) = (at("dead"), at("1"), at("2"), base.path().join("unrelated"));
        [&recreated, &unrelated].into_iter().for_each(|root| fs::create_dir(root).unwrap());
        let mut held = None;
        for root in [&dead, &living] {
            fs::create_dir(root).unwrap();
            held = lock(&lock_path(root), LockMode::New).unwrap();
        }
        let alive = |root: &PathBuf| {
            find_domains(base.path()).into_iter().find(|found| found.root == *root).map(|found| found.alive)
        };
        assert_eq!((alive(&dead), alive(&living)), (Some(false), Some(true)));
        remove_dead(base.path());
        assert_eq!((alive(&dead), alive(&living)), (None, Some(true)));
        assert!(!dead.exists() && !lock_path(&dead).exists());
        assert!(living.exists() && held.is_some());
        assert!(!recreated.exists() && unrelated.exists());
    }
}
