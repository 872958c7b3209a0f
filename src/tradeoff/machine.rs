//! The machine that times were measured on.

use serde::Serialize;

/// What times depend on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Machine {
    /// Name of the processor; empty where the system does not say.
    pub processor: String,
    /// Logical processors.
    pub processors: usize,
    /// Threads that worked.
    pub threads: usize,
    /// Operating system and architecture.
    pub system: String,
    /// Vector instructions that the program's kernels use.
    pub vectors: String,
    /// Features that the program was built with.
    pub features: Vec<&'static str>,
    /// Whether the program was compiled without optimisation: times are then no guide.
    pub debug: bool,
}

impl Machine {
    /// This one.
    #[must_use]
    pub fn here(threads: usize) -> Self {
        let features = [
            ("gdal", cfg!(feature = "gdal")),
            ("proj", cfg!(feature = "proj")),
            ("onednn", cfg!(feature = "onednn")),
            ("cuda", cfg!(feature = "cuda")),
            ("wgpu", cfg!(feature = "wgpu")),
        ];
        Self {
            processor: processor(),
            processors: std::thread::available_parallelism().map_or(1, usize::from),
            threads,
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            vectors: vectors(),
            features: features.into_iter().filter(|(_, on)| *on).map(|(name, _)| name).collect(),
            debug: cfg!(debug_assertions),
        }
    }
}

/// The set of vector instructions that was found, as `pulp` names it: `V3` is AVX2, `V4` AVX-512.
fn vectors() -> String {
    let found = format!("{:?}", pulp::Arch::new());
    found.split('(').next().unwrap_or_default().trim().to_owned()
}

/// The processor's name as Linux gives it.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    text.lines()
        .filter_map(|line| line.split_once(':'))
        .find(|(key, _)| key.trim() == "model name")
        .map_or_else(String::new, |(_, name)| name.trim().to_owned())
}
