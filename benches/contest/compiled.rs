//! C code that is compiled for this machine at run time and loaded: the hand-written step.
//!
//! A missing compiler must not fail the benchmark: the row reports it.

use libloading::Library;
use std::fs;
use std::process::Command;

/// A shared library made from C source.
pub struct Compiled {
    library: Library,
}

/// The flags of a benchmark for this machine.
pub const NATIVE: &[&str] = &["-O3", "-march=native"];
/// The flags for any machine of this kind, like those of the product, with every operation rounded as in the product.
pub const PORTABLE: &[&str] = &["-O3", "-ffp-contract=off"];

impl Compiled {
    /// Compiles and loads C source.
    ///
    /// # Errors
    /// The reason why that is not possible.
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
        let done = compiler.output().map_err(|error| {
            format!("the C compiler `cc` is missing ({error}); install one (Debian: apt install gcc)")
        })?;
        if !done.status.success() {
            return Err(format!("cc failed: {}", String::from_utf8_lossy(&done.stderr).trim()));
        }
        // SAFETY: the source is our own and runs no code when it is loaded.
        let library =
            unsafe { Library::new(&output) }.map_err(|error| format!("cannot load {}: {error}", output.display()))?;
        Ok(Self { library })
    }

    /// Returns the function of this name.
    ///
    /// # Safety
    /// The function must have the type `F`, a function pointer, and must not be called after this library is dropped.
    ///
    /// # Errors
    /// The library has no such function.
    #[allow(unsafe_code)]
    pub unsafe fn function<F: Copy>(&self, name: &str) -> Result<F, String> {
        // SAFETY: guaranteed by the caller.
        let symbol = unsafe { self.library.get::<F>(name.as_bytes()) };
        symbol.map(|symbol| *symbol).map_err(|error| error.to_string())
    }
}
