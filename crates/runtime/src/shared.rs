//! Memory shared between the processes of a run: a file in /dev/shm, mapped, and seen as atomics of one width.
//!
//! The mapping itself orders nothing. A process that stores with Release hands over everything that it wrote before, in this
//! mapping or another, to whoever loads that value with Acquire; a value that stands for itself alone may be Relaxed. Nothing
//! orders a process that dies against its successor but the file's lock: the kernel releases it after the last store.
//!
//! Must not know what the atomics mean.

use crate::files::{open_with, require_own};
use memmap2::MmapRaw;
use rustix::fs::{FallocateFlags, OFlags, fallocate};
use std::fs::{File, OpenOptions};
use std::io;
use std::marker::PhantomData;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// Bytes of the smallest page that there is.
const PAGE_BYTES: usize = 4096;

/// Words of 64 bits in a file that processes share.
pub type SharedWords = Shared<AtomicU64>;
/// Words of 32 bits in a file that processes share: the kernel can wait on them.
pub type SharedHalves = Shared<AtomicU32>;

/// Atomics in a file that processes share. A mapping has one width, because accesses of two widths to the same bytes are a
/// data race even where both are atomic; every process that maps the file names the same one.
#[derive(Debug)]
pub struct Shared<A> {
    map: MmapRaw,
    /// Kept open for the locks that somebody may have on it; the kernel lets go of them when the process dies.
    file: File,
    width: PhantomData<A>,
}

/// An atomic of which a mapping may be made: any bytes are a value of it, and it needs no more than a page's alignment.
pub trait Atomic: sealed::Sealed {
    /// Writes what is there.
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

/// Opens a file of ours, through no link: somebody else could shorten his, and whoever touches what is gone is killed.
fn open(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let file = open_with(path, options.read(true).write(true), OFlags::NOFOLLOW)?;
    require_own(&file)?;
    Ok(file)
}

impl<A: Atomic> Shared<A> {
    /// The atomics in a file as they were left, or so many new ones, all zero. How many there are is for the caller to check.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(path: &Path, count: usize) -> io::Result<Self> {
        let bytes = (count * size_of::<A>()) as u64;
        let file = open(path, OpenOptions::new().create(true).truncate(false).mode(0o600))?;
        if file.metadata()?.len() == 0 {
            // Really allocated, not merely promised: a page that is missing later would kill the process.
            fallocate(&file, FallocateFlags::empty(), 0, bytes)?;
        }
        let shared = Self { map: MmapRaw::map_raw(&file)?, file, width: PhantomData };
        shared.touch();
        Ok(shared)
    }

    /// Writes to every page, nothing new: who writes a little at every tick shall not come upon a new one in the midst of it.
    /// A mapping that is populated by the system is so for reading only, and faults once more when it is written.
    fn touch(&self) {
        self.atomics().chunks(PAGE_BYTES / size_of::<A>()).for_each(|page| page[0].touch());
    }

    /// The atomics in a file that must be there.
    ///
    /// # Errors
    /// The system's reason.
    pub fn existing(path: &Path) -> io::Result<Self> {
        let file = open(path, &mut OpenOptions::new())?;
        // An empty mapping is refused by the system itself.
        Ok(Self { map: MmapRaw::map_raw(&file)?, file, width: PhantomData })
    }

    /// The file. A lock on it ends with this value.
    pub fn file(&self) -> &File {
        &self.file
    }

    #[inline]
    #[allow(unsafe_code)]
    fn atomics(&self) -> &[A] {
        // SAFETY: the mapping is writable, page-aligned, at least `len` bytes long (the file was allocated so, and no
        // process of a run shortens it), and lives as long as `self`; any bytes are an `A`, by `Atomic`; every access to
        // them, in any process, is atomic and of this width.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast::<A>(), self.map.len() / size_of::<A>()) }
    }
}

impl<A> Drop for Shared<A> {
    fn drop(&mut self) {
        // Closing it is not enough: a process that was forked meanwhile has the file too.
        let _ = self.file.unlock();
    }
}

impl SharedWords {
    /// All words.
    #[inline]
    pub fn words(&self) -> &[AtomicU64] {
        self.atomics()
    }
}

impl SharedHalves {
    /// All words of 32 bits.
    #[inline]
    pub fn halves(&self) -> &[AtomicU32] {
        self.atomics()
    }
}

/// A mapping has the atomics of its width only.
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
    fn what_one_mapping_publishes_another_sees() {
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
    fn a_file_keeps_its_length_and_what_is_in_it() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("halves");
        SharedHalves::open(&path, 2048).unwrap().halves()[2047].store(7, Ordering::Relaxed);
        let again = SharedHalves::open(&path, 10).unwrap();
        assert_eq!((again.halves().len(), again.halves()[2047].load(Ordering::Relaxed)), (2048, 7));
        assert!(SharedHalves::existing(&directory.path().join("none")).is_err());
    }
}
