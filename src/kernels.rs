//! What build.rs generated from glsl/: one module per kernel, one structure per GLSL structure behind a pointer.

include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
