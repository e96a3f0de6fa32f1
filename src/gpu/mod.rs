//! Module gpu.
