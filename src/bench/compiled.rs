//! C code that is compiled for this machine when it is needed, and loaded: the hand-written step, the counting allocator.
//!
//! Must not fail a run: where there is no compiler, the rows say so.

use libloading::Library;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A shared library made from C source.
#[derive(Debug)]
pub struct Compiled {
    library: Library,
}

/// What a benchmark should have.
pub(super) const NATIVE: &[&str] = &["-O3", "-march=native"];
/// The same for any machine of this kind, as the product is compiled, and with every operation rounded as it is there.
pub(super) const PORTABLE: &[&str] = &["-O3", "-ffp-contract=off"];

/// Compiles C source as `directory/name.so`, with the given flags beside those of a shared library.
///
/// # Errors
/// Why there is none, in words.
pub(super) fn compile(source: &str, flags: &[&str], directory: &Path, name: &str) -> Result<PathBuf, String> {
    let (input, output) = (directory.join(format!("{name}.c")), directory.join(format!("{name}.so")));
    fs::write(&input, source).map_err(|error| format!("cannot write {}: {error}", input.display()))?;
    let done = Command::new("cc")
        .args(flags)
        .args(["-shared", "-fPIC", "-fvisibility=hidden", "-o"])
        .arg(&output)
        .arg(&input)
        .args(["-lm", "-ldl"])
        .output()
        .map_err(|error| format!("there is no C compiler `cc` ({error}); install one (Debian: apt install gcc)"))?;
    match done.status.success() {
        true => Ok(output),
        false => Err(format!("cc failed: {}", String::from_utf8_lossy(&done.stderr).trim())),
    }
}

impl Compiled {
    /// Compiles and loads C source.
    ///
    /// # Errors
    /// Why that is not possible, in words.
    #[allow(unsafe_code)]
    pub fn new(source: &str, flags: &[&str]) -> Result<Self, String> {
        let directory = temporary_directory()?;
        let path = compile(source, flags, directory.path(), "code")?;
        // SAFETY: our own source, which has no code that runs when it is loaded.
        let library =
            unsafe { Library::new(&path) }.map_err(|error| format!("cannot load {}: {error}", path.display()))?;
        Ok(Self { library })
    }

    /// The function of this name.
    ///
    /// # Safety
    /// It must have the type `F`, which is a function pointer, and must not be called once this is dropped.
    ///
    /// # Errors
    /// That there is none.
    #[allow(unsafe_code)]
    pub(super) unsafe fn function<F: Copy>(&self, name: &str) -> Result<F, String> {
        // SAFETY: the caller's promise.
        let symbol = unsafe { self.library.get::<F>(name.as_bytes()) };
        symbol.map(|symbol| *symbol).map_err(|error| error.to_string())
    }
}

/// A directory for what is compiled; it goes with the value.
pub(super) fn temporary_directory() -> Result<tempfile::TempDir, String> {
    tempfile::tempdir()
        .map_err(|error| format!("cannot make a temporary directory: {error}; set TMPDIR to one that exists"))
}
