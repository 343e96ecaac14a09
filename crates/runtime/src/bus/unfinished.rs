//! Unfinished files: what a process began to make for a run and will never finish.
//!
//! Whoever opens a file whose maker left it at size 0 waits for it, in iceoryx2 0.10 without any limit. Once the file is
//! removed, the opener makes it itself. Must not remove what somebody alive is about to finish.

use super::domain::Domain;
use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// A file that is finished in time is so after some 20 µs. Nobody is looked for before so long: its maker may be in another
/// PID namespace, where it is not seen.
const YOUNG: Duration = Duration::from_millis(20);
/// The owner's right to read: the transport grants it to a file in shared memory last.
const READABLE: u32 = 0o400;
/// The owner's right to write: the transport takes it from the description of a service last.
const WRITABLE: u32 = 0o200;

impl Domain {
    /// The files that somebody has begun and not finished.
    pub fn unfinished(&self) -> Vec<PathBuf> {
        self.begun().into_iter().map(|(path, _)| path).collect()
    }

    /// Removes unfinished files whose maker is gone, or has not finished them for `limit`. True if there are more.
    pub fn remove_unfinished(&self, limit: Duration) -> bool {
        let mut left = false;
        for (path, file) in self.begun() {
            let age = age(&file);
            let abandoned = || !is_open(&path, &file) && is_as_it_was(&path, &file);
            if age > limit || age > YOUNG && abandoned() {
                // What is gone by now is no error, and what cannot be removed is another user's.
                let _ = fs::remove_file(&path);
            } else {
                left = true;
            }
        }
        left
    }

    fn begun(&self) -> Vec<(PathBuf, Metadata)> {
        let in_shared_memory =
            |file: &Metadata| file.is_file() && (file.len() == 0 || file.permissions().mode() & READABLE == 0);
        let of_services = |file: &Metadata| file.permissions().mode() & WRITABLE != 0;
        let services = fs::read_dir(self.root().join("services")).into_iter().flatten().flatten();
        let files =
            self.shared_memory_files().map(|path| (path, true)).chain(services.map(|entry| (entry.path(), false)));
        let begun = files.filter_map(|(path, shared)| {
            let file = fs::symlink_metadata(&path).ok()?;
            let begun = if shared { in_shared_memory(&file) } else { of_services(&file) };
            begun.then_some((path, file))
        });
        begun.collect()
    }
}

/// For how long a file has been as it is. A clock that was set back makes nothing older.
fn age(file: &Metadata) -> Duration {
    let changed = Duration::new(file.ctime().max(0) as u64, file.ctime_nsec() as u32);
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH + changed).unwrap_or_default()
}

/// Whether nobody has changed the file since: its maker may finish it and close it while processes are looked at.
fn is_as_it_was(path: &Path, file: &Metadata) -> bool {
    let state = |file: &Metadata| (file.ino(), file.ctime(), file.ctime_nsec());
    fs::symlink_metadata(path).is_ok_and(|now| state(&now) == state(file))
}

/// Whether a process has the file open. Its maker has, from its creation until it is finished.
fn is_open(path: &Path, file: &Metadata) -> bool {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten().map(|entry| entry.path());
    processes.filter(|process| process.join("fd").is_dir()).any(|process| match fs::read_dir(process.join("fd")) {
        // The name holds the domain's id, so it is nobody else's.
        Ok(descriptors) => descriptors
            .flatten()
            .any(|descriptor| fs::read_link(descriptor.path()).is_ok_and(|open| open.file_name() == path.file_name())),
        // One that hides its descriptors may be the maker if it is of the same user.
        Err(error) => {
            let user = fs::metadata(&process).map(|process| process.uid());
            error.kind() == io::ErrorKind::PermissionDenied && user.is_ok_and(|user| user == file.uid())
        }
    })
}

#[cfg(test)]
mod tests {
    use super::super::domain::{OwnedDomain, SHARED_MEMORY};
    use super::*;
    use std::fs::{File, OpenOptions};
    use std::os::unix::fs::OpenOptionsExt;

    const LIMIT: Duration = Duration::from_secs(3600);

    fn shared(domain: &Domain, name: &str) -> PathBuf {
        Path::new(SHARED_MEMORY).join(domain.prefix() + name)
    }

    fn begin(path: &Path) -> File {
        OpenOptions::new().write(true).create_new(true).mode(WRITABLE).open(path).unwrap()
    }

    /// Looks until nothing is left, or something is that lasts.
    fn settle(domain: &Domain) {
        let end = std::time::Instant::now() + 3 * YOUNG;
        while domain.remove_unfinished(LIMIT) && std::time::Instant::now() < end {
            std::thread::sleep(YOUNG / 4);
        }
    }

    #[test]
    fn what_nobody_will_finish_is_removed_and_nothing_else() {
        let owned = OwnedDomain::create(0).unwrap();
        let domain = owned.domain();
        let services = domain.root().join("services");
        fs::create_dir(&services).unwrap();
        let [empty, unreadable, whole] = ["empty", "unreadable", "whole"].map(|name| shared(domain, name));
        let (described, locked) = (services.join("described"), services.join("locked"));
        drop(begin(&empty));
        begin(&unreadable).set_len(1).unwrap();
        begin(&whole).set_len(1).unwrap();
        fs::set_permissions(&whole, fs::Permissions::from_mode(0o600)).unwrap();
        for (path, mode) in [(&described, 0o400), (&locked, 0o600)] {
            fs::write(path, "").unwrap();
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        }
        assert_eq!(domain.unfinished().len(), 3);
        settle(domain);
        assert_eq!([&empty, &unreadable, &locked].map(|path| path.exists()), [false; 3]);
        assert_eq!([&whole, &described].map(|path| path.exists()), [true; 2]);
    }

    #[test]
    fn what_somebody_has_open_is_left_until_the_limit() {
        let owned = OwnedDomain::create(0).unwrap();
        let path = shared(owned.domain(), "held");
        let held = begin(&path);
        settle(owned.domain());
        assert!(path.exists());
        assert!(!owned.domain().remove_unfinished(Duration::ZERO));
        assert!(!path.exists());
        drop(held);
    }
}
