//! Module mesh.
