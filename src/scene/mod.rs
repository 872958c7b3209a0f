//! Simulated scenes: truth for tests, demos and measurements.
