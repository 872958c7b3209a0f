//! Ctrl-C: the first asks a batch to stop after the items in hand, the second ends the process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A flag that work looks at between items.
#[derive(Clone, Debug, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// A flag that SIGINT and SIGTERM set; a second signal ends the process at once with code 130.
    /// Later calls in the same process share the first call's flag.
    #[must_use]
    pub fn on_signals() -> Self {
        static FLAG: std::sync::OnceLock<Interrupt> = std::sync::OnceLock::new();
        FLAG.get_or_init(|| {
            let flag = Self::default();
            let set = flag.clone();
            let handler = move || {
                if set.0.swap(true, Ordering::SeqCst) {
                    std::process::exit(130);
                }
                eprintln!("stopping after the items in hand; once more to stop at once");
            };
            if let Err(error) = ctrlc::set_handler(handler) {
                tracing::warn!("Ctrl-C will not be handled: {error}");
            }
            flag
        })
        .clone()
    }

    /// Whether work should stop.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }

    /// Asks for a stop from inside the program (a full disk, a test).
    pub fn request(&self) {
        self.0.store(true, Ordering::SeqCst);
    }
}
