//! What build.rs generated from glsl/.
