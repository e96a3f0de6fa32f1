//! Scenes as they come from disk: layouts, lenses, pictures, regions, and what is wrong with them.

mod bad_input;
mod bad_layouts;
mod cameras;
mod fixtures;
mod hostile;
mod layouts;
mod pictures;
mod priors;
mod real;
mod regions;
