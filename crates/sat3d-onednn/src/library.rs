//! The library: found, opened and checked once per process.

use crate::error::{Error, LoadError};
use crate::raw::{self, Functions, Handle, SUCCESS, UNIMPLEMENTED};
use std::ffi::c_int;
use std::sync::OnceLock;

/// Names under which the dynamic linker may know the library.
const NAMES: [&str; 2] = ["libdnnl.so.2", "libdnnl.2.dylib"];
/// An environment variable that names another file.
const VARIABLE: &str = "SAT3D_ONEDNN";

/// oneDNN, loaded, with an engine on the processor.
pub struct Library {
    pub(crate) call: Functions,
    pub(crate) engine: Handle,
    version: (i32, i32, i32),
    set_threads: Option<unsafe extern "C" fn(c_int)>,
    // Its functions are called as long as the process lives.
    _library: libloading::Library,
}

// SAFETY: an engine may be used from any thread (the library's documentation, "Thread safety"); everything else is
// plain functions.
unsafe impl Send for Library {}
// SAFETY: as above.
unsafe impl Sync for Library {}

impl std::fmt::Debug for Library {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Library").field("version", &self.version).finish_non_exhaustive()
    }
}

impl Library {
    /// The library, opened at the first call: the file that `SAT3D_ONEDNN` names, else `libdnnl.so.2`.
    ///
    /// # Errors
    /// [`LoadError`]; the same one at every call.
    pub fn get() -> Result<&'static Self, &'static LoadError> {
        static LIBRARY: OnceLock<Result<Library, LoadError>> = OnceLock::new();
        let open = || {
            let named = std::env::var(VARIABLE).ok().filter(|name| !name.is_empty());
            Self::open(&named.as_deref().map_or(NAMES.to_vec(), |name| vec![name]))
        };
        LIBRARY.get_or_init(open).as_ref()
    }

    fn open(names: &[&str]) -> Result<Self, LoadError> {
        let mut why = String::new();
        for &name in names {
            // SAFETY: loading runs the library's initialisers, which set up OpenMP and read the environment.
            match unsafe { libloading::Library::new(name) } {
                Ok(library) => return Self::start(name, library),
                Err(error) => why = reason(&error),
            }
        }
        Err(LoadError::Missing { tried: names.join(", "), why })
    }

    fn start(file: &str, library: libloading::Library) -> Result<Self, LoadError> {
        let fails = |why: String| LoadError::Start { file: file.into(), why };
        // SAFETY: `dnnl_version` has had this type in all versions, and its result lives as long as the library.
        let version = unsafe {
            let version: libloading::Symbol<'_, unsafe extern "C" fn() -> *const raw::Version> =
                library.get("dnnl_version\0").map_err(|error| fails(reason(&error)))?;
            &*version()
        };
        let version = (version.major, version.minor, version.patch);
        if version.0 != 2 || !(6..=7).contains(&version.1) {
            let found = format!("{}.{}.{}", version.0, version.1, version.2);
            return Err(LoadError::Version { file: file.into(), found });
        }
        // SAFETY: the version was just checked.
        let call = unsafe { Functions::of(&library) }.map_err(|error| fails(reason(&error)))?;
        // OpenMP's, which comes with the library as built by Debian; absent with another threading.
        // SAFETY: `omp_set_num_threads(int)` by the OpenMP standard.
        let set_threads = unsafe {
            library.get::<unsafe extern "C" fn(c_int)>("omp_set_num_threads\0").ok().map(|f| *f)
        };
        let mut engine: Handle = std::ptr::null_mut();
        // SAFETY: writes one handle.
        let status = unsafe { (call.engine_create)(&raw mut engine, raw::CPU, 0) };
        if status != SUCCESS {
            return Err(fails(format!("no engine on the processor (status {status})")));
        }
        Ok(Self { call, engine, version, set_threads, _library: library })
    }

    /// Its version.
    #[must_use]
    pub fn version(&self) -> (i32, i32, i32) {
        self.version
    }

    /// Threads of what the calling thread executes from now on, where the library counts them with OpenMP.
    pub fn set_threads(&self, threads: usize) {
        if let Some(set) = self.set_threads {
            // SAFETY: takes any number.
            unsafe { set(c_int::try_from(threads.max(1)).unwrap_or(c_int::MAX)) };
        }
    }

    /// What the processor offers, as far as the library (and `DNNL_MAX_CPU_ISA`) lets it.
    #[must_use]
    pub fn instructions(&self) -> Instructions {
        // SAFETY: no arguments.
        let set = unsafe { (self.call.effective_isa)() };
        // Each set's number has the bits of those below it (`dnnl_cpu_isa_t`).
        let has = |bits: c_int| set & bits == bits;
        if has(0x3e7) {
            Instructions::Amx
        } else if has(0xe7) {
            Instructions::Avx512Bf16
        } else if has(0x27) {
            Instructions::Avx512
        } else {
            Instructions::Other
        }
    }
}

/// Vector instructions that matter here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Instructions {
    /// Less than AVX-512: no Winograd convolutions, no 16-bit floats.
    Other,
    /// AVX-512.
    Avx512,
    /// With dot products of 16-bit floats.
    Avx512Bf16,
    /// With products of 16-bit tiles.
    Amx,
}

/// The linker's own words, which the error keeps behind its own.
fn reason(error: &libloading::Error) -> String {
    std::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string)
}

/// An error for a status other than success.
pub(crate) fn done(status: c_int, operation: &str) -> Result<(), Error> {
    match status {
        SUCCESS => Ok(()),
        UNIMPLEMENTED => Err(Error::Unimplemented { operation: operation.into() }),
        status => Err(Error::Failed { operation: operation.into(), status }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_there_or_another_library_is_named() {
        let missing = Library::open(&["/none/libdnnl.so.2"]).expect_err("not there").to_string();
        assert!(missing.contains("/none/libdnnl.so.2") && missing.contains("apt-get"), "{missing}");
        if cfg!(target_os = "linux") {
            let other = Library::open(&["libc.so.6"]).expect_err("another library").to_string();
            assert!(other.starts_with("libc.so.6") && other.contains("dnnl_version"), "{other}");
        }
    }

    #[test]
    fn statuses_become_errors() {
        assert_eq!(done(SUCCESS, "x"), Ok(()));
        let none = done(UNIMPLEMENTED, "convolution").expect_err("none").to_string();
        assert_eq!(none, "oneDNN has no convolution on this processor");
        assert!(done(2, "x").expect_err("failed").to_string().contains("status 2"));
    }
}
