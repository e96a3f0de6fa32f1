//! From what was asked for to a `Config`: presets, configuration files, single assignments; and back to readable TOML.
//!
//! Precedence, weakest first: `outdoor-large.toml` (complete), the preset's differences, a file, assignments. Each is laid over the
//! one before it key by key, so that every complaint can name its key and, where there is none of that name, the nearest that exists.

use super::Config;
use crate::{Error, Result};
use toml::{Table, Value};

/// A named set of differences from the complete configuration.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    pub name: &'static str,
    /// What it is for, in one line.
    pub summary: &'static str,
    toml: &'static str,
}

/// Every preset, the default one first.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "outdoor-large",
        summary: "NeuRodin, large outdoor scenes: a GPU, hours",
        toml: COMPLETE,
    },
    Preset {
        name: "indoor-large",
        summary: "NeuRodin, halls and large interiors: a GPU, hours",
        toml: include_str!("presets/indoor-large.toml"),
    },
    Preset {
        name: "indoor-small",
        summary: "NeuRodin, single rooms: a GPU, hours",
        toml: include_str!("presets/indoor-small.toml"),
    },
    Preset {
        name: "outdoor-tiny",
        summary: "objects and outdoor scenes on a software device: minutes",
        toml: include_str!("presets/outdoor-tiny.toml"),
    },
    Preset {
        name: "indoor-tiny",
        summary: "rooms on a software device: minutes",
        toml: include_str!("presets/indoor-tiny.toml"),
    },
];

/// A method that the engine can be set to; what it changes of a preset.
#[derive(Clone, Copy, Debug)]
pub struct Method {
    pub name: &'static str,
    /// What it is, in one line.
    pub summary: &'static str,
    toml: &'static str,
}

/// Every method: NeuRodin, those that it is compared with, and the cases A to E of NeuRodin's ablation.
pub const METHODS: &[Method] = &[
    Method {
        name: "neurodin",
        summary: "NeuRodin as the preset has it",
        toml: "",
    },
    Method {
        name: "volsdf-grid",
        summary: "VolSDF on a hash grid",
        toml: include_str!("methods/volsdf-grid.toml"),
    },
    Method {
        name: "tuvr-grid",
        summary: "TUVR on a hash grid",
        toml: include_str!("methods/tuvr-grid.toml"),
    },
    Method {
        name: "neus-grid",
        summary: "NeuS on a hash grid",
        toml: include_str!("methods/neus-grid.toml"),
    },
    Method {
        name: "neuralangelo",
        summary: "Neuralangelo with four taps",
        toml: include_str!("methods/neuralangelo.toml"),
    },
    Method {
        name: "neuralangelo-6",
        summary: "Neuralangelo with six taps",
        toml: include_str!("methods/neuralangelo-6.toml"),
    },
    Method {
        name: "ablation-a",
        summary: "NeuRodin with one scale for all points",
        toml: include_str!("methods/ablation-a.toml"),
    },
    Method {
        name: "ablation-b",
        summary: "NeuRodin with an analytic gradient in stage 1",
        toml: include_str!("methods/ablation-b.toml"),
    },
    Method {
        name: "ablation-c",
        summary: "NeuRodin without bias correction",
        toml: include_str!("methods/ablation-c.toml"),
    },
    Method {
        name: "ablation-d",
        summary: "NeuRodin without eikonal loss in stage 1",
        toml: include_str!("methods/ablation-d.toml"),
    },
    Method {
        name: "ablation-e",
        summary: "NeuRodin without eikonal loss, and with an analytic gradient, in stage 1",
        toml: include_str!("methods/ablation-e.toml"),
    },
];

/// What a preset's name ends with for the same at the largest dictionary, 2^22.
pub const HUGE: &str = "-huge";

/// The complete, commented configuration; also the template of [`Config::to_toml`].
const COMPLETE: &str = include_str!("presets/outdoor-large.toml");

impl Default for Config {
    fn default() -> Self {
        toml::from_str(COMPLETE).expect("outdoor-large.toml is complete and well-formed")
    }
}

impl Config {
    /// The configuration of a preset, or with the ending [`HUGE`] the same with 2^22 entries in every hashed level.
    ///
    /// # Errors
    /// [`Error::Config`] for an unknown name, with the nearest one.
    pub fn preset(name: &str) -> Result<Config> {
        if let Some(base) = name.strip_suffix(HUGE) {
            let mut config = Config::preset(base)?;
            config.preset = name.into();
            config.hash.log2_size = 22;
            return Ok(config);
        }
        let Some(preset) = PRESETS.iter().find(|preset| preset.name == name) else {
            let hint = match nearest(name, PRESETS.iter().map(|preset| preset.name)) {
                Some(near) => format!("did you mean '{near}'? "),
                None => String::new(),
            };
            let all: Vec<_> = PRESETS.iter().map(|preset| preset.name).collect();
            return Err(Error::Config {
                what: format!(
                    "unknown preset '{name}'; {hint}there are: {}, and each of them with {HUGE}",
                    all.join(", ")
                ),
            });
        };
        let complete = Table::try_from(Config::default()).expect("a configuration is a table");
        let table = parse(preset.toml, preset.name)?;
        overlay(complete, &table, &format!("preset {name}"))
    }

    /// This configuration set to another method. A preset at its full length stays at that of the method; one that is stretched, and a
    /// method with one stage, take all the steps of all stages.
    ///
    /// # Errors
    /// [`Error::Config`] for an unknown name, with the nearest one, and where another method than NeuRodin has left its settings.
    pub fn with_method(self, name: &str) -> Result<Config> {
        let Some(method) = METHODS.iter().find(|method| method.name == name) else {
            let hint = match nearest(name, METHODS.iter().map(|method| method.name)) {
                Some(near) => format!("did you mean '{near}'? "),
                None => String::new(),
            };
            let all: Vec<_> = METHODS.iter().map(|method| method.name).collect();
            return Err(Error::Config {
                what: format!(
                    "unknown method '{name}'; {hint}there are: {}",
                    all.join(", ")
                ),
            });
        };
        if self.method == name {
            return Ok(self);
        }
        if self.method != METHODS[0].name {
            return Err(Error::Config {
                what: format!(
                    "method {name}: the settings are those of {} already\n  next: leave that method, and what it sets, out of the file or the run \
                     that they come from",
                    self.method
                ),
            });
        }
        let (total, full_length) = (self.total_steps(), self.steps == self.schedule_steps);
        let table = Table::try_from(self).expect("a configuration is a table");
        let source = format!("method {name}");
        let mut config = overlay(table, &parse(method.toml, &source)?, &source)?;
        // A method of one stage has all steps in it; a second stage is as long as it is.
        if config.stage2.steps == 0 && config.first_step == 0 {
            config.steps = match full_length {
                true => config.schedule_steps,
                false => total,
            };
        }
        Ok(config)
    }

    /// The configuration in a TOML text, which may be partial: its key `preset` (default: outdoor-large) says what it differs from.
    /// `source` names the text in error messages.
    ///
    /// # Errors
    /// [`Error::Config`] for text that is not TOML, unknown keys and presets, and values of the wrong type or out of range.
    pub fn from_toml(text: &str, source: &str) -> Result<Config> {
        Config::from_toml_or(text, source, Config::default())?.validated()
    }

    /// The configuration that a run recorded with [`Config::to_toml`]: nothing comes from the preset that it began with, which may
    /// have changed since. A setting that the text lacks is younger than it, and has the value that outdoor-large.toml gives it: new
    /// settings have there what was done before them.
    ///
    /// # Errors
    /// As [`Config::from_toml`].
    pub fn recorded(text: &str, source: &str) -> Result<Config> {
        let complete = Table::try_from(Config::default()).expect("a configuration is a table");
        overlay(complete, &parse(text, source)?, source)?.validated()
    }

    /// As [`Config::from_toml`], but a text without the key `preset` differs from `base`; ranges are not checked yet.
    ///
    /// # Errors
    /// As [`Config::from_toml`].
    pub fn from_toml_or(text: &str, source: &str, base: Config) -> Result<Config> {
        let base = match parse(text, source)?.get("preset") {
            None => base,
            Some(Value::String(name)) => Config::preset(name)?,
            Some(other) => {
                return Err(Error::Config {
                    what: format!(
                        "{source}: preset = {other}: expected the name of a preset in quotes"
                    ),
                });
            }
        };
        base.with_toml(text, source)
    }

    /// This configuration, with the method that a partial TOML text may name, and the text laid over it; ranges are not checked yet.
    ///
    /// # Errors
    /// As [`Config::from_toml`].
    pub fn with_toml(self, text: &str, source: &str) -> Result<Config> {
        let text = parse(text, source)?;
        let config = match text.get("method") {
            Some(Value::String(method)) => self.with_method(method)?,
            _ => self,
        };
        let table = Table::try_from(config).expect("a configuration is a table");
        overlay(table, &text, source)
    }

    /// This configuration with one assignment `group.key=value` made; ranges are not checked yet. Values are written as in TOML,
    /// names without quotes, lists with or without brackets.
    ///
    /// # Errors
    /// [`Error::Config`] naming key, value and expected type, or the nearest existing key.
    pub fn with_assignment(self, assignment: &str) -> Result<Config> {
        let Some((key, text)) = assignment.split_once('=') else {
            return Err(Error::Config {
                what: format!(
                    "'{assignment}' is no assignment; write key=value, for example hash.log2_size=19"
                ),
            });
        };
        let (key, text) = (key.trim(), text.trim());
        if key == "preset" || key == "method" {
            return Err(Error::Config {
                what: format!("the {key} is not a setting among others; use --{key} {text}"),
            });
        }
        let mut table = Table::try_from(self).expect("a configuration is a table");
        let path: Vec<&str> = key.split('.').collect();
        let slot = slot(&mut table, &path).map_err(|why| Error::Config { what: why })?;
        let expected = type_of(slot);
        *slot = read_as(slot, text).ok_or_else(|| Error::Config {
            what: format!("{key}={text}: expected {expected}"),
        })?;
        check(table, key, text)
    }

    /// Every setting as TOML, each with the comment that explains it. [`Config::recorded`] and [`Config::from_toml`] read it back to an
    /// equal configuration.
    pub fn to_toml(&self) -> String {
        let table = Table::try_from(self).expect("a configuration is a table");
        let mut text = String::new();
        let mut group: Vec<&str> = Vec::new();
        for line in COMPLETE.lines() {
            if let Some(header) = line.strip_prefix('[') {
                group = header.split(']').next().unwrap_or("").split('.').collect();
            } else if let Some((key, rest)) = line.split_once(" = ") {
                let value = group
                    .iter()
                    .try_fold(&table, |table, name| table.get(*name)?.as_table())
                    .and_then(|table| table.get(key))
                    .expect("outdoor-large.toml holds the keys of a configuration");
                let setting = format!("{key} = {value}");
                text += &match rest.split_once('#') {
                    Some((_, comment)) => format!("{setting:<28} #{comment}\n"),
                    None => setting + "\n",
                };
                continue;
            }
            text += line;
            text.push('\n');
        }
        text
    }
}

/// The table of a TOML text.
fn parse(text: &str, source: &str) -> Result<Table> {
    text.parse::<Table>().map_err(|error| Error::Config {
        what: format!("{source}: {error}"),
    })
}

/// Lays `over` onto the complete table, leaf by leaf.
fn overlay(mut complete: Table, over: &Table, source: &str) -> Result<Config> {
    let mut leaves = Vec::new();
    collect_leaves(over, &mut Vec::new(), &mut leaves);
    for (path, value) in &leaves {
        let names: Vec<&str> = path.iter().map(String::as_str).collect();
        let key = names.join(".");
        let in_source = |what: String| Error::Config {
            what: format!("{source}: {what}"),
        };
        let slot = slot(&mut complete, &names).map_err(in_source)?;
        *slot = match (&*slot, value) {
            (Value::Float(_), Value::Integer(whole)) => Value::Float(*whole as f64),
            (old, new) if old.same_type(new) => new.clone(),
            (old, new) => {
                let expected = type_of(old);
                return Err(in_source(format!("{key} = {new}: expected {expected}")));
            }
        };
        check(complete.clone(), &key, &value.to_string())
            .map_err(|error| in_source(error.to_string()))?;
    }
    complete
        .try_into()
        .map_err(|error: toml::de::Error| Error::Config {
            what: format!("{source}: {}", error.message()),
        })
}

fn collect_leaves(table: &Table, path: &mut Vec<String>, leaves: &mut Vec<(Vec<String>, Value)>) {
    for (name, value) in table {
        path.push(name.clone());
        match value {
            Value::Table(inner) => collect_leaves(inner, path, leaves),
            leaf => leaves.push((path.clone(), leaf.clone())),
        }
        path.pop();
    }
}

/// The setting at a path, or why there is none.
fn slot<'t>(table: &'t mut Table, path: &[&str]) -> Result<&'t mut Value, String> {
    let key = path.join(".");
    let mut leaves = Vec::new();
    collect_leaves(table, &mut Vec::new(), &mut leaves);
    let keys: Vec<String> = leaves.into_iter().map(|(path, _)| path.join(".")).collect();
    if !keys.contains(&key) {
        let inside: Vec<&str> = keys
            .iter()
            .filter(|existing| existing.starts_with(&format!("{key}.")))
            .map(String::as_str)
            .collect();
        if !inside.is_empty() {
            return Err(format!(
                "'{key}' is a group of settings: {}",
                inside.join(", ")
            ));
        }
        return Err(match nearest(&key, keys.iter().map(String::as_str)) {
            Some(near) => format!("unknown key '{key}'; did you mean '{near}'?"),
            None => format!("unknown key '{key}'; `neurodin train --print-config` lists every key"),
        });
    }
    let (last, groups) = path.split_last().expect("a key has at least one name");
    let group = groups.iter().fold(table, |table, name| {
        table[*name]
            .as_table_mut()
            .expect("the path leads through groups")
    });
    Ok(&mut group[*last])
}

/// The name most like `name`, if any is like it at all: by the whole path, or by its last part alone.
pub(crate) fn nearest<'n>(name: &str, names: impl Iterator<Item = &'n str>) -> Option<&'n str> {
    let last = |path: &str| path.rsplit('.').next().unwrap_or(path).to_string();
    names
        .map(|existing| {
            let whole = strsim::jaro_winkler(name, existing);
            let part = strsim::jaro_winkler(&last(name), &last(existing));
            // The group decides between equal last parts.
            (existing, whole.max(0.9 * part + 0.1 * whole))
        })
        .filter(|(_, likeness)| *likeness > 0.7)
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(existing, _)| existing)
}

/// A value's type, for a person.
fn type_of(value: &Value) -> String {
    match value {
        Value::String(_) => "a name".into(),
        Value::Integer(_) => "a whole number".into(),
        Value::Float(_) => "a number".into(),
        Value::Boolean(_) => "true or false".into(),
        Value::Array(list) => match list.first() {
            Some(first) => format!("a list, each {}", type_of(first)),
            None => "a list".into(),
        },
        Value::Datetime(_) | Value::Table(_) => "a group".into(),
    }
}

/// Reads a command-line word as a value of the old value's type.
fn read_as(old: &Value, text: &str) -> Option<Value> {
    let digits = text.replace('_', "");
    match old {
        Value::String(_) => Some(Value::String(text.trim_matches(['"', '\'']).into())),
        Value::Integer(_) => whole_number(&digits).map(Value::Integer),
        Value::Float(_) => digits.parse().ok().map(Value::Float),
        Value::Boolean(_) => text.parse().ok().map(Value::Boolean),
        Value::Array(_) => {
            let inner = text.trim_start_matches('[').trim_end_matches(']');
            inner
                .split(',')
                .map(|item| whole_number(&item.trim().replace('_', "")).map(Value::Integer))
                .collect::<Option<Vec<_>>>()
                .map(Value::Array)
        }
        Value::Datetime(_) | Value::Table(_) => None,
    }
}

/// "300000", or "3e5".
fn whole_number(digits: &str) -> Option<i64> {
    digits.parse().ok().or_else(|| {
        let number: f64 = digits.parse().ok()?;
        (number.fract() == 0.0 && number.abs() < 9e15).then_some(number as i64)
    })
}

/// The table as a configuration, or the complaint about the one key that was just changed.
fn check(table: Table, key: &str, value: &str) -> Result<Config> {
    table
        .try_into()
        .map_err(|error: toml::de::Error| Error::Config {
            what: format!("{key}={value}: {}", error.message()),
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{BackgroundKind, DensityKind, Effect, RegionKind};

    fn complaint(result: Result<Config>) -> String {
        let error = result.expect_err("a complaint");
        assert!(matches!(error, Error::Config { .. }), "{error:?}");
        error.to_string()
    }

    #[test]
    fn presets_are_sound_and_survive_the_round_trip() {
        for preset in PRESETS {
            let config = Config::preset(preset.name).unwrap().validated().unwrap();
            assert_eq!(config.preset, preset.name);
            let text = config.to_toml();
            assert!(text.contains("# of every random number"), "comments stay");
            assert_eq!(Config::from_toml(&text, "text").unwrap(), config);
            assert_eq!(Config::recorded(&text, "text").unwrap(), config);
        }
    }

    #[test]
    fn a_recorded_run_lacks_what_came_after_it() {
        let tiny = Config::preset("outdoor-tiny").unwrap();
        assert!(tiny.loss.color_squared > 0.0, "else this tests nothing");
        let older: String = tiny
            .to_toml()
            .lines()
            .filter(|line| !line.starts_with("color_squared"))
            .map(|line| format!("{line}\n"))
            .collect();
        let run = Config::recorded(&older, "config.toml").unwrap();
        let differences = tiny.differences(&run);
        let keys: Vec<&str> = differences.iter().map(|d| d.key.as_str()).collect();
        assert_eq!(keys, ["loss.color_squared"]);
        assert_eq!(run.loss.color_squared, 0.0);
        let told = complaint(Config::recorded("rays = 'many'", "config.toml"));
        assert!(told.contains("config.toml"), "{told}");
    }

    #[test]
    fn methods_are_sound_on_every_preset() {
        for preset in PRESETS {
            for method in METHODS {
                let start = Config::preset(preset.name).unwrap();
                let total = start.total_steps();
                let config = start.with_method(method.name).unwrap().validated().unwrap();
                assert_eq!(
                    (config.preset.as_str(), config.method.as_str()),
                    (preset.name, method.name)
                );
                let own_length = config.steps == config.schedule_steps;
                assert!(own_length || config.total_steps() == total);
                if let Some(second) = config.second_stage() {
                    second.validated().unwrap();
                }
                let text = config.to_toml();
                assert_eq!(Config::from_toml(&text, "text").unwrap(), config);
                assert_eq!(Config::recorded(&text, "text").unwrap(), config);
            }
        }
        let partial = "preset = 'outdoor-tiny'\nmethod = 'neus-grid'\nrays = 8\n";
        let config = Config::from_toml(partial, "text").unwrap();
        assert_eq!(
            (config.rays, config.surface.density),
            (8, DensityKind::Neus)
        );
        let told = complaint(Config::default().with_method("neus"));
        assert!(told.contains("did you mean 'neus-grid'?"), "{told}");
    }

    #[test]
    fn huge_presets_differ_in_the_dictionary_alone() {
        let mut huge = Config::preset("indoor-tiny-huge").unwrap();
        assert_eq!(huge.hash.log2_size, 22);
        huge.hash.log2_size = 17;
        huge.preset = "indoor-tiny".into();
        assert_eq!(huge, Config::preset("indoor-tiny").unwrap());
        assert!(complaint(Config::preset("indor-tiny-huge")).contains("'indoor-tiny'"));
    }

    /// The numbers that distinguish the configurations of NeuRodin's released code (nerfstudio/configs/method_configs.py).
    #[test]
    fn published_differences() {
        let [outdoor, hall, room] = ["outdoor-large", "indoor-large", "indoor-small"]
            .map(|name| Config::preset(name).unwrap());
        assert_eq!([outdoor.rays, hall.rays, room.rays], [1024, 1024, 512]);
        assert_eq!(
            [
                outdoor.hash.features,
                hall.hash.features,
                room.hash.features
            ],
            [8, 8, 2]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.surface.inside_out),
            [false, true, true]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.background.kind),
            [
                BackgroundKind::Field,
                BackgroundKind::None,
                BackgroundKind::None
            ]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.loss.bias.weight),
            [0.1, 0.05, 0.05]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.loss.bias.offset),
            [0.001, 0.001, 0.01]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.loss.bias.ramp_steps),
            [0, 10_000, 10_000]
        );
        assert_eq!(
            [&outdoor, &hall, &room].map(|config| config.stage2.rays),
            [8192, 8192, 512]
        );
        for config in [&outdoor, &hall, &room] {
            let second = config.second_stage().expect("two stages");
            let rise = |config: &Config| {
                [
                    config.optimizer.fields.warmup,
                    config.optimizer.table.warmup,
                ]
            };
            assert_eq!(rise(config), [5000, 5000]);
            assert_eq!(rise(&second), [5000, 5000]);
        }
        let tiny = Config::preset("outdoor-tiny").expect("a preset");
        let second = tiny.second_stage().expect("two stages");
        assert_eq!(second.optimizer.table.warmup, 60_000);
        assert_eq!(tiny.optimizer.table.warmup, 5000);
    }

    #[test]
    fn unknown_names_are_answered_with_the_nearest() {
        assert!(complaint(Config::preset("outdor-tiny")).contains("'outdoor-tiny'"));
        let assign = |text: &str| complaint(Config::default().with_assignment(text));
        for (text, near) in [
            ("hash.log2size=22", "'hash.log2_size'"),
            ("log2_size=22", "log2_size'"),
            ("hash.log2_hashmap_size=22", "'hash.log2_size'"),
            ("ray=12", "'rays'"),
            ("loss.eikonal_weight=1", "'loss.eikonal'"),
            (
                "optimizer.field.learning_rate=1",
                "'optimizer.fields.learning_rate'",
            ),
        ] {
            let told = assign(text);
            assert!(
                told.contains(near) && told.contains(text.split('=').next().unwrap()),
                "{told}"
            );
        }
        let told = complaint(Config::from_toml("[hash]\nlevls = 3\n", "my.toml"));
        assert!(
            told.contains("my.toml") && told.contains("'hash.levels'"),
            "{told}"
        );
        assert!(complaint(Config::from_toml("preset = 'x'", "my.toml")).contains("outdoor-large"));
        assert!(
            assign("hash=3").contains("hash.levels"),
            "a group lists its keys"
        );
    }

    #[test]
    fn assignments_are_read_by_type() {
        let config = Config::default()
            .with_assignment("hash.log2_size=22")
            .and_then(|config| config.with_assignment("steps = 3e3"))
            .and_then(|config| config.with_assignment("loss.eikonal=1"))
            .and_then(|config| config.with_assignment("scene.shape=box"))
            .and_then(|config| config.with_assignment("surface.inside_out=true"))
            .and_then(|config| config.with_assignment("sampling.proposal_samples=64,48"))
            .unwrap();
        assert_eq!(
            (config.hash.log2_size, config.steps, config.loss.eikonal),
            (22, 3000, 1.0)
        );
        assert_eq!(
            (config.scene.shape, config.surface.inside_out),
            (RegionKind::Box, true)
        );
        assert_eq!(config.sampling.proposal_samples, [64, 48]);
        for (text, expected) in [
            ("hash.log2_size=big", "a whole number"),
            ("hash.levels=1.5", "a whole number"),
            ("hash.levels=-1", "u32"),
            ("loss.eikonal=much", "a number"),
            ("surface.inside_out=yes", "true or false"),
            ("scene.shape=cone", "`sphere`"),
            ("sampling.proposal_samples=64", "array of length 2"),
            ("hash.levels", "key=value"),
            ("preset=indoor-tiny", "--preset"),
        ] {
            let told = complaint(Config::default().with_assignment(text));
            let (key, value) = text.split_once('=').unwrap_or((text, ""));
            assert!(told.contains(expected), "{text}: {told}");
            assert!(
                key == "preset" || told.contains(key) && told.contains(value),
                "{text}: {told}"
            );
        }
        let told = complaint(Config::from_toml("rays = 'many'", "my.toml"));
        assert!(
            told.contains("rays") && told.contains("whole number"),
            "{told}"
        );
        assert!(complaint(Config::from_toml("rays = ", "my.toml")).contains("my.toml"));
    }

    #[test]
    fn ranges_are_checked_together() {
        let wrong = Config::default()
            .with_toml(
                "rays = 0\n[hash]\nfeatures = 3\nlevels = 17\nmax = 8",
                "text",
            )
            .unwrap();
        let told = complaint(wrong.validated());
        for key in [
            "rays = 0",
            "hash.features = 3",
            "hash.levels = 17",
            "hash.max = 8",
        ] {
            assert!(told.contains(key), "{told}");
        }
        let not_a_number = Config::default()
            .with_assignment("loss.eikonal=nan")
            .unwrap();
        assert!(complaint(not_a_number.validated()).contains("loss.eikonal"));
    }

    #[test]
    fn steps_are_shared_by_the_stages() {
        let tiny = Config::preset("outdoor-tiny").unwrap();
        assert_eq!((tiny.steps, tiny.stage2.steps), (9000, 3000));
        let both = tiny.with_total_steps(2001);
        assert_eq!(
            (both.steps, both.stage2.steps, both.total_steps()),
            (1501, 500, 2001)
        );
        let second = both.second_stage().unwrap();
        assert_eq!(
            (second.first_step, second.steps, second.stage2.steps),
            (1501, 500, 0)
        );
        assert_eq!(second.total_steps(), 2001);
        let again = second.clone().with_method("neurodin").unwrap();
        assert_eq!(again.steps, 500, "a method does not lengthen it");
        // Lengthened when it has begun, only what is left of it can be.
        assert_eq!(second.with_total_steps(3001).steps, 1500);
        let mut first_only = both;
        first_only.stage2.steps = 0;
        assert_eq!(first_only.with_total_steps(70).steps, 70);
    }

    #[test]
    fn differences_are_listed_with_their_effect() {
        let was = Config::default();
        let now = was
            .clone()
            .with_toml(
                "steps = 10\n[hash]\nlog2_size = 22\n[report]\nkeep = 5",
                "text",
            )
            .unwrap();
        let effects: Vec<_> = was
            .differences(&now)
            .into_iter()
            .map(|difference| (difference.to_string(), difference.effect))
            .collect();
        assert_eq!(effects.len(), 3, "{effects:?}");
        assert!(effects.contains(&("hash.log2_size: 19 -> 22".into(), Effect::Incompatible)));
        assert!(effects.contains(&("steps: 300000 -> 10".into(), Effect::Course)));
        assert!(effects.contains(&("report.keep: 2 -> 5".into(), Effect::None)));
        assert!(was.differences(&was).is_empty());
    }
}
