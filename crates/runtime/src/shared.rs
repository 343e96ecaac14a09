//! Memory shared between the processes of a run: a mapped file in /dev/shm, accessed as atomics of one width.
//!
//! The mapping itself orders nothing. A Release store makes everything that the process wrote before, in any mapping, visible
//! to a process that loads the value with Acquire. A value that depends on no other may be Relaxed. Between a process that
//! dies and its successor only the file's lock orders accesses: the kernel releases it after the last store.
//!
//! This file does not know what the atomics mean.

use crate::files::{open_with, require_own};
use memmap2::MmapRaw;
use rustix::fs::{FallocateFlags, OFlags, fallocate};
use std::fs::{File, OpenOptions};
use std::io;
use std::marker::PhantomData;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// The size of the smallest page, bytes.
const PAGE_BYTES: usize = 4096;

/// 64-bit words in a file shared between processes.
pub type SharedWords = Shared<AtomicU64>;
/// 32-bit words in a file shared between processes. The kernel can wait on them.
pub type SharedHalves = Shared<AtomicU32>;

/// Atomics in a file shared between processes. A mapping has one width: accesses of two widths to the same bytes are a data
/// race, even if both are atomic. Every process that maps the file must use the same width.
#[derive(Debug)]
pub struct Shared<A> {
    map: MmapRaw,
    /// Open for the locks held on it, which the kernel releases when the process dies.
    file: File,
    width: PhantomData<A>,
}

/// An atomic that can be mapped: any bytes are a valid value, and page alignment suffices.
pub trait Atomic: sealed::Sealed {
    /// Writes the current value again.
    fn touch(&self);
}

mod sealed {
    pub trait Sealed {}
    impl Sealed for super::AtomicU64 {}
    impl Sealed for super::AtomicU32 {}
}

impl Atomic for AtomicU64 {
    fn touch(&self) {
        let _ = self.compare_exchange(0, 0, Ordering::Relaxed, Ordering::Relaxed);
    }
}

impl Atomic for AtomicU32 {
    fn touch(&self) {
        let _ = self.compare_exchange(0, 0, Ordering::Relaxed, Ordering::Relaxed);
    }
}

/// Opens a file of this user, and follows no link. Another user could shorten a foreign file, and access beyond its end kills
/// the process.
fn open(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let file = open_with(path, options.read(true).write(true), OFlags::NOFOLLOW)?;
    require_own(&file)?;
    Ok(file)
}

impl<A: Atomic> Shared<A> {
    /// Opens the atomics in a file, or creates `count` new ones, all zero. The caller checks the number of existing ones.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(path: &Path, count: usize) -> io::Result<Self> {
        let bytes = (count * size_of::<A>()) as u64;
        let file = open(path, OpenOptions::new().create(true).truncate(false).mode(0o600))?;
        if file.metadata()?.len() == 0 {
            // Allocated now: a page that cannot be allocated later would kill the process.
            fallocate(&file, FallocateFlags::empty(), 0, bytes)?;
        }
        let shared = Self { map: MmapRaw::map_raw(&file)?, file, width: PhantomData };
        shared.touch();
        Ok(shared)
    }

    /// Writes to every page without changing it, so that no later write faults. Pages populated by the kernel are mapped for
    /// reading and fault once more at the first write.
    fn touch(&self) {
        self.atomics().chunks(PAGE_BYTES / size_of::<A>()).for_each(|page| page[0].touch());
    }

    /// Opens the atomics in an existing file.
    ///
    /// # Errors
    /// The system's reason.
    pub fn existing(path: &Path) -> io::Result<Self> {
        let file = open(path, &mut OpenOptions::new())?;
        // The system refuses an empty mapping.
        Ok(Self { map: MmapRaw::map_raw(&file)?, file, width: PhantomData })
    }

    /// Returns the file. A lock on it ends with this value.
    pub fn file(&self) -> &File {
        &self.file
    }

    #[inline]
    #[allow(unsafe_code)]
    fn atomics(&self) -> &[A] {
        // SAFETY: the mapping is writable and page-aligned, and lives as long as `self`. It has the length of the file, which was
        // allocated and which no process of a run shortens. Any bytes are a valid `A`, by `Atomic`. Every process accesses them
        // atomically and with this width.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast::<A>(), self.map.len() / size_of::<A>()) }
    }
}

impl<A> Drop for Shared<A> {
    fn drop(&mut self) {
        // Closing is not enough: a process forked meanwhile holds the file too.
        let _ = self.file.unlock();
    }
}

impl SharedWords {
    /// Returns all words.
    #[inline]
    pub fn words(&self) -> &[AtomicU64] {
        self.atomics()
    }
}

impl SharedHalves {
    /// Returns all 32-bit words.
    #[inline]
    pub fn halves(&self) -> &[AtomicU32] {
        self.atomics()
    }
}

/// A mapping offers only atomics of its width.
///
/// ```compile_fail,E0599
/// # extern crate corotate_runtime as corotate;
/// use corotate::shared::SharedWords;
/// let words = SharedWords::existing("/dev/shm/any".as_ref()).unwrap();
/// words.halves();
/// ```
///
/// ```compile_fail,E0599
/// # extern crate corotate_runtime as corotate;
/// use corotate::shared::SharedHalves;
/// let halves = SharedHalves::existing("/dev/shm/any".as_ref()).unwrap();
/// halves.words();
/// ```
#[cfg(doctest)]
pub struct OneWidth;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stores_in_one_mapping_are_visible_in_another() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("words");
        let (here, there) = (SharedWords::open(&path, 1000).unwrap(), SharedWords::existing(&path).unwrap());
        assert_eq!((here.words().len(), there.words().len()), (1000, 1000));
        let writer = std::thread::spawn(move || {
            for value in 1..=1000 {
                here.words()[999].store(value, Ordering::Relaxed);
                here.words()[0].store(value, Ordering::Release);
            }
        });
        let mut seen = 0;
        while seen < 1000 {
            seen = there.words()[0].load(Ordering::Acquire);
            assert!(there.words()[999].load(Ordering::Relaxed) >= seen);
        }
        writer.join().unwrap();
    }

    #[test]
    fn a_file_keeps_its_length_and_content() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("halves");
        SharedHalves::open(&path, 2048).unwrap().halves()[2047].store(7, Ordering::Relaxed);
        let again = SharedHalves::open(&path, 10).unwrap();
        assert_eq!((again.halves().len(), again.halves()[2047].load(Ordering::Relaxed)), (2048, 7));
        assert!(SharedHalves::existing(&directory.path().join("none")).is_err());
    }
}
