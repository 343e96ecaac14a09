//! Memory shared between the processes of a run: a file in /dev/shm, mapped, and seen as words that are read and written
//! whole.
//!
//! Must not know what the words mean.

use memmap2::MmapRaw;
use rustix::fs::{FallocateFlags, fallocate};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// Words of the smallest page that there is.
const PAGE_WORDS: usize = 4096 / size_of::<u64>();

/// Words in a file that processes share.
#[derive(Debug)]
pub struct SharedWords {
    map: MmapRaw,
    /// Kept open for the locks that somebody may have on it; the kernel lets go of them when the process dies.
    file: File,
}

impl SharedWords {
    /// The words in a file as they were left, or so many new ones, all zero. How many there are is for the caller to check.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(path: &Path, words: usize) -> io::Result<Self> {
        let bytes = (words * size_of::<u64>()) as u64;
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(path)?;
        if file.metadata()?.len() == 0 {
            // Really allocated, not merely promised: a page that is missing later would kill the process.
            fallocate(&file, FallocateFlags::empty(), 0, bytes)?;
        }
        let words = Self { map: MmapRaw::map_raw(&file)?, file };
        words.touch();
        Ok(words)
    }

    /// Writes to every page, nothing new: who writes a little at every tick shall not come upon a new one in the midst of it.
    /// A mapping that is populated by the system is so for reading only, and faults once more when it is written.
    fn touch(&self) {
        for page in self.words().chunks(PAGE_WORDS) {
            let _ = page[0].compare_exchange(0, 0, Ordering::Relaxed, Ordering::Relaxed);
        }
    }

    /// The words in a file that must be there.
    ///
    /// # Errors
    /// The system's reason.
    pub fn existing(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(path)?;
        // An empty mapping is refused by the system itself.
        Ok(Self { map: MmapRaw::map_raw(&file)?, file })
    }

    /// The file.
    pub fn file(&self) -> &File {
        &self.file
    }

    /// All words.
    #[inline]
    #[allow(unsafe_code)]
    pub fn words(&self) -> &[AtomicU64] {
        // SAFETY: the mapping is writable, page-aligned, at least `len` bytes long (the file was allocated so, and no
        // process of a run shortens it), and lives as long as `self`; every access to it, in any process, is atomic.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast::<AtomicU64>(), self.map.len() / size_of::<u64>()) }
    }

    /// The same as halves of words, which the kernel can wait on. Whoever uses these does not use the words.
    #[inline]
    #[allow(unsafe_code)]
    pub fn halves(&self) -> &[AtomicU32] {
        // SAFETY: as above; a page is aligned for both.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast::<AtomicU32>(), self.map.len() / size_of::<u32>()) }
    }
}
