//! What differs between two configurations, and whether a run may go on under the other one.

use super::Config;
use std::fmt;
use toml::{Table, Value};

/// One setting that is not the same in two configurations.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    pub key: String,
    pub was: String,
    pub now: String,
    pub effect: Effect,
}

/// What changing a setting does to a run that is already under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// What is learned stays the same.
    None,
    /// Training goes on, but is no longer the run that was begun.
    Course,
    /// Saved parameters no longer fit: their shapes, the region or the images they belong to are others.
    Incompatible,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: {} -> {}", self.key, self.was, self.now)
    }
}

/// Groups and keys after whose change a checkpoint cannot be used.
const INCOMPATIBLE: &[&str] = &[
    "first_step",
    "scene.",
    "hash.levels",
    "hash.base",
    "hash.max",
    "hash.log2_size",
    "hash.features",
    "surface.hidden",
    "surface.features",
    "surface.inside_out",
    "surface.scale",
    "color.hidden",
    "color.layers",
    "appearance.dims",
    "sampling.proposal_levels",
    "sampling.proposal_base",
    "sampling.proposal_max",
    "sampling.proposal_log2_size",
    "sampling.proposal_features",
    "sampling.proposal_hidden",
    "background.kind",
    "background.levels",
    "background.base",
    "background.max",
    "background.log2_size",
    "background.features",
    "background.hidden",
    "background.geometry",
    "background.contraction",
];

/// Groups and keys without influence on what is learned.
const WITHOUT_EFFECT: &[&str] = &["report.", "appearance.at_eval", "preset"];

impl Config {
    /// The settings that differ in `now`, in the order of their keys.
    pub fn differences(&self, now: &Config) -> Vec<Difference> {
        let table = |config: &Config| Table::try_from(config).expect("a configuration is a table");
        let mut found = Vec::new();
        compare("", &table(self), &table(now), &mut found);
        found
    }
}

fn compare(group: &str, was: &Table, now: &Table, found: &mut Vec<Difference>) {
    for (name, old) in was {
        let key = format!("{group}{name}");
        match (old, &now[name]) {
            (Value::Table(old), Value::Table(new)) => compare(&format!("{key}."), old, new, found),
            (old, new) if old != new => found.push(Difference {
                effect: effect(&key),
                was: old.to_string(),
                now: new.to_string(),
                key,
            }),
            _ => {}
        }
    }
}

fn effect(key: &str) -> Effect {
    let among = |list: &[&str]| {
        list.iter()
            .any(|entry| key == *entry || (entry.ends_with('.') && key.starts_with(entry)))
    };
    if among(INCOMPATIBLE) {
        Effect::Incompatible
    } else if among(WITHOUT_EFFECT) {
        Effect::None
    } else {
        Effect::Course
    }
}
