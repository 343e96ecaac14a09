//! Unfinished files: created by a process that will never finish them.
//!
//! iceoryx2 0.10 waits without limit for a file that its maker left at size 0. Once the file is removed, the waiting
//! process creates it itself. Must not remove a file that a living process is about to finish.

use super::domain::Domain;
use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Minimum age before the maker is looked for: a living maker finishes within some 20 µs, and may be invisible in
/// another PID namespace.
const YOUNG: Duration = Duration::from_millis(20);
/// Read permission of the owner: the transport sets it last on a file in shared memory.
const READABLE: u32 = 0o400;
/// Write permission of the owner: the transport removes it last from the description of a service.
const WRITABLE: u32 = 0o200;

impl Domain {
    /// Returns the unfinished files of the domain.
    pub fn unfinished(&self) -> Vec<PathBuf> {
        self.begun().into_iter().map(|(path, _)| path).collect()
    }

    /// Removes unfinished files whose maker is gone or has not finished them for `limit`; returns true if some remain.
    pub fn remove_unfinished(&self, limit: Duration) -> bool {
        let mut left = false;
        for (path, file) in self.begun() {
            let age = age(&file);
            let abandoned = || !is_open(&path, &file) && is_as_it_was(&path, &file);
            if age > limit || age > YOUNG && abandoned() {
                // A file that has vanished is no error; one that cannot be removed belongs to another user.
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

/// Returns the time since a file changed; zero if the clock was set back.
fn age(file: &Metadata) -> Duration {
    let changed = Duration::new(file.ctime().max(0) as u64, file.ctime_nsec() as u32);
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH + changed).unwrap_or_default()
}

/// Returns true if the file has not changed: its maker may have finished it while processes were searched.
fn is_as_it_was(path: &Path, file: &Metadata) -> bool {
    let state = |file: &Metadata| (file.ino(), file.ctime(), file.ctime_nsec());
    fs::symlink_metadata(path).is_ok_and(|now| state(&now) == state(file))
}

/// Returns true if a process has the file open. Its maker has it open until the file is finished.
fn is_open(path: &Path, file: &Metadata) -> bool {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten().map(|entry| entry.path());
    processes.filter(|process| process.join("fd").is_dir()).any(|process| match fs::read_dir(process.join("fd")) {
        // The name contains the domain's ID, so it is unique.
        Ok(descriptors) => descriptors
            .flatten()
            .any(|descriptor| fs::read_link(descriptor.path()).is_ok_and(|open| open.file_name() == path.file_name())),
        // A process of the same user that hides its descriptors may be the maker.
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

    /// Removes files until none is left or the time is over.
    fn settle(domain: &Domain) {
        let end = std::time::Instant::now() + 3 * YOUNG;
        while domain.remove_unfinished(LIMIT) && std::time::Instant::now() < end {
            std::thread::sleep(YOUNG / 4);
        }
    }

    #[test]
    fn only_abandoned_files_are_removed() {
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
    fn an_open_file_stays_until_the_limit() {
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
