//! The rules of the repository that a compiler does not check.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Files of the source tree with their paths relative to the repository, generated and foreign folders left out.
fn sources() -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    for folder in ["src", "glsl", "tests", "tools", "benches", "examples"] {
        collect(root, &root.join(folder), &mut found);
    }
    for file in ["build.rs", ".ci/run"] {
        if let Ok(text) = fs::read_to_string(root.join(file)) {
            found.push((PathBuf::from(file), text));
        }
    }
    assert!(
        found.len() > 20,
        "only {} files found below {}",
        found.len(),
        root.display()
    );
    found
}

fn collect(root: &Path, folder: &Path, found: &mut Vec<(PathBuf, String)>) {
    let Ok(entries) = fs::read_dir(folder) else {
        return;
    };
    for entry in entries {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(root, &path, found);
        } else if let Ok(text) = fs::read_to_string(&path) {
            found.push((path.strip_prefix(root).unwrap().to_path_buf(), text));
        }
    }
}

/// Fails with the whole list, so that one run shows everything.
fn none(rule: &str, offences: Vec<String>) {
    assert!(offences.is_empty(), "{rule}:\n  {}", offences.join("\n  "));
}

fn is(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e == extension)
}

/// Lines that satisfy `bad`, as `file:line: text`.
fn lines(files: &[(PathBuf, String)], bad: impl Fn(&str) -> bool) -> Vec<String> {
    files
        .iter()
        .flat_map(|(path, text)| {
            let name = path.display().to_string();
            text.lines()
                .enumerate()
                .filter(|(_, line)| bad(line))
                .map(|(number, line)| format!("{name}:{}: {}", number + 1, line.trim()))
                .collect::<Vec<_>>()
        })
        .collect()
}

/// This file spells out what it forbids.
fn others() -> Vec<(PathBuf, String)> {
    let mut files = sources();
    files.retain(|(path, _)| path != Path::new("tests/tidy.rs"));
    files
}

#[test]
fn files_are_named_for_what_they_hold() {
    let bad = [
        "utils", "util", "common", "helpers", "helper", "types", "manager", "misc",
    ];
    let offences = sources()
        .iter()
        .filter(|(path, _)| {
            path.iter().any(|part| {
                let stem = Path::new(part).file_stem().unwrap_or_default();
                bad.iter().any(|name| stem == *name)
            })
        })
        .map(|(path, _)| path.display().to_string())
        .collect();
    none(
        "no file or folder is called utils, common, helpers, types or manager",
        offences,
    );
}

#[test]
fn files_are_short_enough_to_read() {
    let offences = sources()
        .iter()
        .filter(|(_, text)| text.lines().count() > 800)
        .map(|(path, text)| format!("{}: {} lines", path.display(), text.lines().count()))
        .collect();
    none("a file has at most 800 lines; split it by noun", offences);
}

#[test]
fn every_rust_file_begins_by_saying_what_it_is() {
    let offences = sources()
        .iter()
        .filter(|(path, text)| {
            is(path, "rs") && !text.starts_with("//! ") && !text.starts_with("#!")
        })
        .map(|(path, _)| path.display().to_string())
        .collect();
    none(
        "a Rust file begins with a sentence: //! what it is",
        offences,
    );
}

#[test]
fn every_kernel_begins_by_saying_what_it_computes() {
    let mut kernels = 0;
    let mut offences = Vec::new();
    for (path, text) in sources() {
        if !path.starts_with("glsl") || !(is(&path, "comp") || is(&path, "glsl")) {
            continue;
        }
        kernels += 1;
        let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        let first = lines.next().unwrap_or_default();
        if is(&path, "comp") && first != "#version 460" {
            offences.push(format!(
                "{}: the first line is not #version 460",
                path.display()
            ));
            continue;
        }
        // The sentence comes before any declaration; switches for the prelude and includes may stand above it.
        let mut lines = text
            .lines()
            .map(str::trim)
            .filter(|line| !line.is_empty() && !line.starts_with('#'));
        let sentence = lines.next().unwrap_or_default();
        let words = sentence.trim_start_matches("//").split_whitespace().count();
        if !sentence.starts_with("// ") || words < 4 {
            offences.push(format!("{}: begins with {sentence:?}", path.display()));
        }
    }
    assert!(kernels > 0, "no kernels found below glsl/");
    none(
        "a kernel begins with a sentence: // what it computes, and its source",
        offences,
    );
}

#[test]
fn only_the_gpu_layer_is_unsafe_or_knows_vulkan() {
    let mut files = others();
    files.retain(|(path, _)| is(path, "rs") && !path.starts_with("src/gpu"));
    let offences = lines(&files, |line| {
        let code = line.split("//").next().unwrap_or_default();
        let unsafe_code = code
            .split(|c: char| !c.is_alphanumeric() && c != '_')
            .any(|word| word == "unsafe");
        unsafe_code || code.contains("vk::") || code.contains("ash::")
    });
    // Text in the code generator is code of src/gpu.
    let offences = offences
        .into_iter()
        .filter(|line| !line.starts_with("build.rs"))
        .collect();
    none("unsafe and vk:: stay inside src/gpu", offences);
}

#[test]
fn every_unsafe_block_says_why_it_is_sound() {
    let mut offences = Vec::new();
    for (path, text) in sources() {
        if !path.starts_with("src/gpu") || !is(&path, "rs") {
            continue;
        }
        let lines: Vec<&str> = text.lines().collect();
        for (number, line) in lines.iter().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            if !code.contains("unsafe {") && !code.contains("unsafe impl") {
                continue;
            }
            // Somewhere in the few lines above the block, or on it.
            let above = lines[number.saturating_sub(6)..=number].join("\n");
            if !above.contains("SAFETY:") {
                offences.push(format!(
                    "{}:{}: {}",
                    path.display(),
                    number + 1,
                    line.trim()
                ));
            }
        }
    }
    none("an unsafe block has a SAFETY: comment", offences);
}

#[test]
fn nothing_is_kept_equal_by_comment() {
    let offences = lines(&others(), |line| {
        let line = line.to_lowercase();
        ["keep in sync", "kept in sync", "must match the"]
            .iter()
            .any(|phrase| line.contains(phrase))
    });
    none("what has to be equal is declared once", offences);
}

/// The rooms that a file names by `crate::room` or `crate::{room::.., ..}`, comments and its own tests left out.
fn imports(text: &str) -> BTreeSet<String> {
    let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or("");
    let code: Vec<&str> = code
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .collect();
    let code = code.join("\n");
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        let rest = &code[at + "crate::".len()..];
        let (mut depth, mut name) = (0, String::new());
        for character in rest.chars() {
            match character {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ if depth <= 1 && (character.is_alphanumeric() || character == '_') => {
                    name.push(character);
                    continue;
                }
                ':' if depth == 1 && name.is_empty() => continue,
                _ => {}
            }
            if depth <= 1 && !name.is_empty() {
                found.insert(std::mem::take(&mut name));
            }
            if depth == 0 {
                break;
            }
        }
    }
    found
}

#[test]
fn rooms_import_what_the_architecture_says() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = fs::read_to_string(root.join("ARCHITECTURE.md")).unwrap();
    let arrows = page.lines().filter_map(|line| line.split_once(" → "));
    let said: BTreeMap<String, BTreeSet<String>> = arrows
        .filter(|(room, _)| root.join("src").join(room.trim()).is_dir())
        .map(|(room, others)| {
            let others = others.split(", ").filter(|other| *other != "nothing");
            (room.trim().into(), others.map(str::to_owned).collect())
        })
        .collect();
    assert!(said.len() > 5, "{said:?}");
    let mut there: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (path, text) in sources() {
        let Ok(inside) = path.strip_prefix("src") else {
            continue;
        };
        let room = inside.components().next().unwrap().as_os_str();
        let room = room.to_string_lossy().replace(".rs", "");
        if !said.contains_key(&room) {
            assert!(!root.join("src").join(&room).is_dir(), "no arrow of {room}");
            continue;
        }
        let others = imports(&text)
            .into_iter()
            .filter(|other| *other != room && said.contains_key(other));
        there.entry(room.clone()).or_default().extend(others);
    }
    assert_eq!(said, there);
}

#[test]
fn nothing_is_left_for_later() {
    let offences = lines(&others(), |line| {
        [
            "TODO",
            "FIXME",
            "XXX",
            "HACK",
            "todo!",
            "unimplemented!",
            "#[ignore",
        ]
        .iter()
        .any(|mark| line.contains(mark))
    });
    none("no stubs and no notes to finish something later", offences);
}

#[test]
fn only_the_program_prints_and_exits() {
    let mut files = others();
    files.retain(|(path, _)| {
        is(path, "rs")
            && path.starts_with("src")
            && !path.starts_with("src/cli")
            && path != Path::new("src/main.rs")
    });
    let offences = lines(&files, |line| {
        let code = line.split("//").next().unwrap_or_default();
        ["println!", "eprintln!", "dbg!", "process::exit", "env::var"]
            .iter()
            .any(|call| code.contains(call))
    });
    none(
        "the library neither prints, nor exits, nor reads the environment",
        offences,
    );
}
