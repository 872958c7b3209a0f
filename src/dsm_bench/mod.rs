//! The ground-truth DSM benchmark: plan, build, manifest.
