//! C code that is compiled for this machine when it is needed, and loaded: the hand-written step.
//!
//! Must not fail a run: where there is no compiler, the row says so.

use libloading::Library;
use std::fs;
use std::process::Command;

/// A shared library made from C source.
pub struct Compiled {
    library: Library,
}

/// What a benchmark should have.
pub const NATIVE: &[&str] = &["-O3", "-march=native"];
/// The same for any machine of this kind, as the product is compiled, and with every operation rounded as it is there.
pub const PORTABLE: &[&str] = &["-O3", "-ffp-contract=off"];

impl Compiled {
    /// Compiles and loads C source.
    ///
    /// # Errors
    /// Why that is not possible, in words.
    #[allow(unsafe_code)]
    pub fn new(source: &str, flags: &[&str]) -> Result<Self, String> {
        let directory = tempfile::tempdir()
            .map_err(|error| format!("cannot make a temporary directory: {error}; set TMPDIR to one that exists"))?;
        let [input, output] = ["code.c", "code.so"].map(|name| directory.path().join(name));
        fs::write(&input, source).map_err(|error| format!("cannot write {}: {error}", input.display()))?;
        let mut compiler = Command::new("cc");
        compiler
            .args(flags)
            .args(["-shared", "-fPIC", "-fvisibility=hidden", "-o"])
            .arg(&output)
            .arg(&input)
            .arg("-lm");
        let done = compiler
            .output()
            .map_err(|error| format!("there is no C compiler `cc` ({error}); install one (Debian: apt install gcc)"))?;
        if !done.status.success() {
            return Err(format!("cc failed: {}", String::from_utf8_lossy(&done.stderr).trim()));
        }
        // SAFETY: our own source, which has no code that runs when it is loaded.
        let library =
            unsafe { Library::new(&output) }.map_err(|error| format!("cannot load {}: {error}", output.display()))?;
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
    pub unsafe fn function<F: Copy>(&self, name: &str) -> Result<F, String> {
        // SAFETY: the caller's promise.
        let symbol = unsafe { self.library.get::<F>(name.as_bytes()) };
        symbol.map(|symbol| *symbol).map_err(|error| error.to_string())
    }
}
