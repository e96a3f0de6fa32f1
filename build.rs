//! Compiles glsl/*.comp and writes their Rust twins.
//!
//! Each kernel becomes the module `kernels::<stem>` with `Args` (the push-constant block, field for field), `Shape` (the specialisation
//! constants with their GLSL defaults) and its SPIR-V; structures behind pointers become `kernels::<Name>`. Nothing optimises the
//! SPIR-V: that would strip the names that reflection reads, and drivers optimise anyway. A kernel that adds to floats atomically is
//! compiled twice, and so is one that reads pairs as 64-bit integers: once with CORE_ONLY, for devices that lack either.

#[allow(dead_code)]
#[path = "src/gpu/reflect.rs"]
mod reflect;

use glslang::{Compiler, CompilerOptions, ShaderInput, ShaderMessage, ShaderSource, ShaderStage};
use glslang::{SourceLanguage, SpirvVersion, Target, VulkanVersion};
use reflect::{Field, Module, Struct, Type, Value};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// Changes whenever this file changes what it makes of the same GLSL.
const RECIPE: &str = "vulkan 1.2, spir-v 1.5, unoptimised, 1";
/// Defined for the second variant of a kernel: Vulkan 1.2 without what is optional there.
const CORE_ONLY: &str = "CORE_ONLY";
/// Defined for the third variant of a kernel that handles gradients: their sums do not depend on the order.
const DETERMINISTIC: &str = "DETERMINISTIC";
/// What the file of a kernel's second form has in its name: the same by cooperative matrices, `<stem>.cooperative.comp`.
const COOPERATIVE: &str = "cooperative";
/// Specialisation constants from here on are the device's: what it multiplies, and how many lanes read at once (lib/cooperative.glsl,
/// lib/abreast.glsl).
const DEVICE_CONSTANTS: u32 = 100;
/// The constant of kernels that read items abreast.
const LANES: &str = "LANES";
/// The pointer type of gradients (lib/sums.glsl).
const SUMS: &str = "SumsMut ";
/// Every implementation has this much, and lavapipe of 2022 no more.
const PUSH_CONSTANT_BYTES: u32 = 128;

fn main() {
    println!("cargo:rerun-if-changed=glsl");
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=src/gpu/reflect.rs");
    name_commit();
    let out = PathBuf::from(env::var("OUT_DIR").expect("cargo sets OUT_DIR"));
    let glsl =
        PathBuf::from(env::var("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR"))
            .join("glsl");
    let mut paths: Vec<PathBuf> = fs::read_dir(&glsl)
        .expect("the folder glsl lies beside build.rs")
        .map(|entry| entry.expect("glsl can be listed").path())
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "comp")
        })
        .collect();
    paths.sort();
    let forms: Vec<PathBuf> = paths
        .extract_if(.., |path| stem_of(path).contains('.'))
        .collect();

    let mut text = String::new();
    let mut structs: BTreeMap<String, (String, Struct)> = BTreeMap::new();
    let mut errors = Vec::new();
    for path in &paths {
        let second = format!("{}.{COOPERATIVE}", stem_of(path));
        let second = forms.iter().find(|form| stem_of(form) == second);
        match kernel(&glsl, path, second, &out, &mut structs) {
            Ok(module) => text.push_str(&module),
            Err(error) => errors.push(error),
        }
    }
    for form in &forms {
        let of = stem_of(form).strip_suffix(&format!(".{COOPERATIVE}"));
        if !of.is_some_and(|of| paths.iter().any(|path| stem_of(path) == of)) {
            errors.push(format!(
                "{}: no kernel that this could be a form of; <kernel>.{COOPERATIVE}.comp expected",
                form.display()
            ));
        }
    }
    for (name, (kernel, layout)) in &structs {
        match structure(name, layout, kernel) {
            Ok(item) => text.push_str(&item),
            Err(error) => errors.push(error),
        }
    }
    if !errors.is_empty() {
        for line in errors.iter().flat_map(|error| error.lines()) {
            println!("cargo::error={line}");
        }
        std::process::exit(1);
    }
    let stems = paths.iter().map(|path| stem_of(path));
    let modules: String = stems.map(|stem| format!("&{stem}::MODULE, ")).collect();
    let _ = writeln!(
        text,
        "/// Every kernel, by name.\npub static ALL: &[&crate::gpu::KernelModule] = &[{modules}];"
    );
    write_if_changed(&out.join("kernels.rs"), text.as_bytes());
}

/// Tells release builds the commit that they are made from, for --version. Others are spared a new build after every commit.
fn name_commit() {
    let log = Path::new(".git/logs/HEAD");
    if env::var("PROFILE").is_ok_and(|profile| profile == "release") && log.exists() {
        println!("cargo:rerun-if-changed={}", log.display());
        let asked = Command::new("git")
            .args(["rev-parse", "--short", "HEAD"])
            .output();
        if let Ok(answer) = asked.map(|output| String::from_utf8_lossy(&output.stdout).into_owned())
        {
            println!("cargo:rustc-env=NEURODIN_GIT_HASH={}", answer.trim());
        }
    }
}

/// A kernel's name: its file's.
fn stem_of(path: &Path) -> &str {
    path.file_stem()
        .and_then(|stem| stem.to_str())
        .expect("kernel files have plain names")
}

/// Compiles one kernel with all its variants, or takes what an earlier build made of the same text, and returns its module's Rust text.
fn kernel(
    glsl: &Path,
    path: &Path,
    cooperative: Option<&PathBuf>,
    out: &Path,
    structs: &mut BTreeMap<String, (String, Struct)>,
) -> Result<String, String> {
    let stem = stem_of(path);
    let (source, module) = form(glsl, path, out)?;
    if module.cooperative {
        return Err(format!(
            "glsl/{stem}.comp: cooperative matrices belong into glsl/{stem}.{COOPERATIVE}.comp, beside what runs everywhere"
        ));
    }
    let second = match cooperative {
        None => None,
        Some(path) => {
            let (source, second) = form(glsl, path, out)?;
            let foreign = second.constants.iter().find(|constant| {
                constant.id < DEVICE_CONSTANTS && !module.constants.contains(constant)
            });
            if second.args != module.args || foreign.is_some() {
                return Err(format!(
                    "glsl/{stem}.{COOPERATIVE}.comp: Args and constants must be those of glsl/{stem}.comp{}",
                    foreign.map_or(String::new(), |c| format!(" ({} is not)", c.name))
                ));
            }
            Some(kernel_module(stem_of(path), &source, &second, "None"))
        }
    };
    for (name, layout) in &module.structs {
        match structs.get(name) {
            Some((other, known)) if known.fields != layout.fields => {
                return Err(format!(
                    "glsl/{stem}.comp and glsl/{other}.comp declare struct {name} differently"
                ));
            }
            Some((_, known)) if known.stride.is_some() => {}
            _ => drop(structs.insert(name.clone(), (stem.to_string(), layout.clone()))),
        }
    }
    rust_module(stem, &source, &module, second)
        .map_err(|error| format!("glsl/{stem}.comp: {error}"))
}

/// One file of a kernel: compiled with its variants, and reflected.
fn form(glsl: &Path, path: &Path, out: &Path) -> Result<(Source, Module), String> {
    let stem = stem_of(path);
    let source = Source::flatten(glsl, path)?;
    let spirv = compiled(&source, stem, "", out)?;
    let module = Module::read(&spirv).map_err(|error| format!("glsl/{stem}.comp: {error}"))?;
    if module.beyond_core {
        let fallback = compiled(&source, stem, CORE_ONLY, out)?;
        let fallback =
            Module::read(&fallback).map_err(|error| format!("glsl/{stem}.comp: {error}"))?;
        if fallback.beyond_core {
            return Err(format!(
                "glsl/{stem}.comp: needs float atomics or 64-bit integers, though {CORE_ONLY} is defined (lib/prelude.glsl)"
            ));
        }
    }
    if source.declares(SUMS) {
        compiled(&source, stem, DETERMINISTIC, out)?;
    }
    Ok((source, module))
}

/// A kernel's text with its includes in place, and where each line came from.
struct Source {
    text: String,
    lines: Vec<(String, usize)>,
    /// The comment above the block: what the kernel does.
    about: Vec<String>,
}

impl Source {
    fn flatten(glsl: &Path, path: &Path) -> Result<Source, String> {
        let mut source = Source {
            text: String::new(),
            lines: Vec::new(),
            about: Vec::new(),
        };
        source.append(glsl, path, &mut Vec::new())?;
        let own =
            fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
        let mut comment = own.lines().skip_while(|line| !line.starts_with("//"));
        let first = comment.by_ref().take_while(|line| line.starts_with("//"));
        source.about = first
            .map(|line| line.trim_start_matches('/').trim().to_string())
            .collect();
        Ok(source)
    }

    /// Whether the kernel has an argument or a variable of this type.
    fn declares(&self, ty: &str) -> bool {
        let mut lines = self.text.lines();
        lines.any(|line| line.trim_start().starts_with(ty))
    }

    /// Appends a file; names in `#include "..."` are looked for beside the file, then under glsl/. Each file enters once.
    fn append(&mut self, glsl: &Path, path: &Path, seen: &mut Vec<PathBuf>) -> Result<(), String> {
        let name = path
            .strip_prefix(glsl)
            .unwrap_or(path)
            .display()
            .to_string();
        let text = fs::read_to_string(path).map_err(|error| format!("glsl/{name}: {error}"))?;
        seen.push(path.to_path_buf());
        for (number, line) in text.lines().enumerate() {
            let include = line
                .trim_start()
                .strip_prefix("#include")
                .map(|rest| rest.trim());
            if let Some(wanted) = include {
                let wanted = wanted
                    .strip_prefix('"')
                    .and_then(|rest| rest.split('"').next());
                let wanted = wanted.ok_or(format!(
                    "glsl/{name}:{}: #include \"file\" expected",
                    number + 1
                ))?;
                let beside = path.parent().expect("a file lies in a folder").join(wanted);
                let found = [beside, glsl.join(wanted)]
                    .into_iter()
                    .find(|candidate| candidate.is_file());
                let found = found.ok_or(format!("glsl/{name}:{}: no file {wanted}", number + 1))?;
                let found = found
                    .canonicalize()
                    .map_err(|error| format!("{}: {error}", found.display()))?;
                if !seen.contains(&found) {
                    self.append(glsl, &found, seen)?;
                }
                continue;
            }
            self.text.push_str(line);
            self.text.push('\n');
            self.lines.push((name.clone(), number + 1));
        }
        Ok(())
    }

    /// glslang's messages, with the line of the flattened text replaced by file and line.
    fn locate(&self, log: &str) -> String {
        let mut located = String::new();
        let noise = ["Log:", "compilation terminated", "No code generated."];
        let told =
            |line: &&str| !line.is_empty() && !noise.iter().any(|noise| line.ends_with(noise));
        for line in log.lines().map(str::trim).filter(told) {
            let place = line.split_once(": 0:").and_then(|(kind, rest)| {
                let (number, message) = rest.split_once(':')?;
                let (file, number) = self
                    .lines
                    .get(number.parse::<usize>().ok()?.checked_sub(1)?)?;
                Some(format!(
                    "glsl/{file}:{number}: {}:{message}",
                    kind.to_lowercase()
                ))
            });
            located.push_str(&place.unwrap_or_else(|| line.to_string()));
            located.push('\n');
        }
        located
    }
}

/// SPIR-V of a kernel's variant, from OUT_DIR where its text has not changed.
fn compiled(source: &Source, stem: &str, define: &str, out: &Path) -> Result<Vec<u32>, String> {
    let mut hasher = DefaultHasher::new();
    (RECIPE, define, &source.text).hash(&mut hasher);
    let key = format!("{:016x}", hasher.finish());
    let file = out.join(spirv_file(stem, define));
    let key_file = file.with_extension("key");
    if fs::read_to_string(&key_file).is_ok_and(|known| known == key)
        && let Ok(bytes) = fs::read(&file)
    {
        return Ok(bytes
            .chunks_exact(4)
            .map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]]))
            .collect());
    }
    let spirv = compile(source, define)?;
    let bytes: Vec<u8> = spirv.iter().flat_map(|word| word.to_le_bytes()).collect();
    fs::write(&file, bytes).expect("OUT_DIR can be written");
    fs::write(&key_file, key).expect("OUT_DIR can be written");
    Ok(spirv)
}

fn spirv_file(stem: &str, define: &str) -> String {
    match define {
        "" => format!("{stem}.spv"),
        define => format!("{stem}.{}.spv", define.to_lowercase()),
    }
}

fn compile(source: &Source, define: &str) -> Result<Vec<u32>, String> {
    let options = CompilerOptions {
        source_language: SourceLanguage::GLSL,
        target: Target::Vulkan {
            version: VulkanVersion::Vulkan1_2,
            spirv_version: SpirvVersion::SPIRV1_5,
        },
        version_profile: None,
        messages: ShaderMessage::DEFAULT,
    };
    let compiler = Compiler::acquire().expect("glslang starts");
    let text = ShaderSource::from(source.text.as_str());
    let defines: &[(&str, Option<&str>)] = match define {
        "" => &[],
        define => &[(define, None)],
    };
    let input = ShaderInput::new(&text, ShaderStage::Compute, &options, Some(defines), None);
    let input = input.map_err(|error| format!("glsl/{}: {error}", source.lines[0].0))?;
    let shader = compiler
        .create_shader(input)
        .map_err(|error| source.locate(&error.to_string()))?;
    shader
        .compile()
        .map_err(|error| source.locate(&error.to_string()))
}

fn write_if_changed(path: &Path, bytes: &[u8]) {
    if !fs::read(path).is_ok_and(|known| known == bytes) {
        fs::write(path, bytes).expect("OUT_DIR can be written");
    }
}

/// `kernels::<stem>`: the block's twin, the constants, the tables that the recorder and the pipelines need; `second` is the kernel's
/// form by cooperative matrices.
fn rust_module(
    stem: &str,
    source: &Source,
    module: &Module,
    second: Option<String>,
) -> Result<String, String> {
    let mut text = String::new();
    let w = &mut text;
    let about = source
        .about
        .iter()
        .map(|line| format!("/// {}\n", doc(line)))
        .collect::<String>();
    let _ = writeln!(w, "{about}pub mod {stem} {{");

    let _ = writeln!(w, "/// Arguments of `{stem}`: its push-constant block.");
    let bytes = rust_struct(w, "Args", &module.args, None, &|field| {
        field_comment(source, field)
    })?;
    if bytes > PUSH_CONSTANT_BYTES {
        return Err(format!(
            "Args has {bytes} bytes, the portable limit is {PUSH_CONSTANT_BYTES}: put numbers behind one pointer"
        ));
    }

    let derives = "#[derive(Clone, Copy, Debug, PartialEq)]";
    let _ = writeln!(
        w,
        "/// What is fixed when `{stem}` is built: its specialisation constants.\n{derives}\npub struct Shape {{"
    );
    let mut defaults = String::new();
    let mut bits = String::new();
    let of_shape = module
        .constants
        .iter()
        .filter(|constant| constant.id < DEVICE_CONSTANTS);
    for constant in of_shape.clone() {
        if constant.name.is_empty() {
            return Err(format!(
                "specialisation constant {} has no name",
                constant.id
            ));
        }
        let name = identifier(&constant.name.to_lowercase());
        let (ty, default, word) = match constant.default {
            Value::F32(v) => (
                "f32",
                format!("f32::from_bits({})", v.to_bits()),
                format!("self.{name}.to_bits()"),
            ),
            Value::U32(v) => ("u32", v.to_string(), format!("self.{name}")),
            Value::I32(v) => ("i32", v.to_string(), format!("self.{name} as u32")),
            Value::Bool(v) => ("bool", v.to_string(), format!("self.{name} as u32")),
        };
        let _ = writeln!(
            w,
            "/// `{}`, default {}.\npub {name}: {ty},",
            constant.name,
            value_text(constant.default)
        );
        let _ = write!(defaults, "{name}: {default}, ");
        let _ = write!(bits, "({}, {word}), ", constant.id);
    }
    let derivable = "#[allow(clippy::derivable_impls)]\n";
    let _ = writeln!(
        w,
        "}}\n{derivable}impl Default for Shape {{ fn default() -> Self {{ Self {{ {defaults} }} }} }}"
    );
    let count = of_shape.count();
    let _ = writeln!(
        w,
        "impl crate::gpu::KernelShape for Shape {{\ntype Args = Args;"
    );
    let _ = writeln!(
        w,
        "fn module() -> &'static crate::gpu::KernelModule {{ &MODULE }}"
    );
    let _ = writeln!(
        w,
        "fn constants(&self) -> Vec<(u32, u32)> {{ let constants: [(u32, u32); {count}] = [{bits}]; constants.to_vec() }}\n}}"
    );

    let cooperative = match second {
        None => "None".into(),
        Some(second) => {
            let ty = "crate::gpu::KernelModule";
            let _ = writeln!(w, "static COOPERATIVE: {ty} = {second};");
            "Some(&COOPERATIVE)".to_string()
        }
    };
    let _ = writeln!(
        w,
        "pub(super) static MODULE: crate::gpu::KernelModule = {};\n}}",
        kernel_module(stem, source, module, &cooperative)
    );
    Ok(text)
}

/// The `KernelModule` of one file of a kernel.
fn kernel_module(stem: &str, source: &Source, module: &Module, cooperative: &str) -> String {
    let embed = |define| {
        format!(
            "include_bytes!(concat!(env!(\"OUT_DIR\"), \"/{}\"))",
            spirv_file(stem, define)
        )
    };
    let fallback = match module.beyond_core {
        true => format!("Some({})", embed(CORE_ONLY)),
        false => "None".into(),
    };
    let deterministic = match source.declares(SUMS) {
        true => format!("Some({})", embed(DETERMINISTIC)),
        false => "None".into(),
    };
    let size = |name: &str| {
        let mut constants = module.constants.iter();
        let constant = constants.find(|constant| constant.name == name);
        constant.map_or("0".into(), |constant| value_text(constant.default))
    };
    let matrix_tile = match module.cooperative {
        true => format!(
            "Some([{}])",
            ["TILE_M", "TILE_N", "TILE_K"].map(size).join(", ")
        ),
        false => "None".into(),
    };
    let mut pointers = String::new();
    for field in &module.args {
        if let Type::Pointer { writable, .. } = field.ty {
            let (name, offset) = (&field.name, field.offset);
            let _ = write!(
                pointers,
                "crate::gpu::PointerArg {{ name: {name:?}, offset: {offset}, writable: {writable} }}, "
            );
        }
    }
    format!(
        "crate::gpu::KernelModule {{ name: {stem:?}, local_size: {:?}, spirv: {}, spirv_of_core: {fallback}, \
         deterministic_spirv: {deterministic}, cooperative: {cooperative}, matrix_tile: {matrix_tile}, pointers: &[{pointers}], indirect_reads: {}, \
         indirect_writes: {}, lanes: {} }}",
        module.local_size,
        embed(""),
        module.indirect_reads,
        module.indirect_writes,
        module
            .constants
            .iter()
            .any(|constant| constant.name == LANES)
    )
}

/// `kernels::<Name>`: a structure that lies behind pointers.
fn structure(name: &str, layout: &Struct, kernel: &str) -> Result<String, String> {
    let mut text = format!(
        "/// What `{kernel}` and others that name it find behind a pointer: GLSL's `struct {name}`.\n"
    );
    rust_struct(&mut text, name, &layout.fields, layout.stride, &|_| None)
        .map_err(|error| format!("glsl/{kernel}.comp: {error}"))?;
    Ok(text)
}

/// Writes a `#[repr(C)]` structure and the proof of its offsets; returns its size.
fn rust_struct(
    w: &mut String,
    name: &str,
    fields: &[Field],
    stride: Option<u32>,
    comment: &dyn Fn(&Field) -> Option<String>,
) -> Result<u32, String> {
    let derives = "#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]";
    let _ = writeln!(w, "#[repr(C)]\n{derives}\npub struct {name} {{");
    let mut asserts = String::new();
    let mut end = Some(0);
    for field in fields {
        if end.is_some_and(|end| end != field.offset) {
            return Err(format!(
                "{name}.{} lies at byte {}, after a gap: pointers are aligned to 8 bytes, put them in front",
                field.name, field.offset
            ));
        }
        end = field.ty.size().map(|size| field.offset + size);
        let (ident, ty) = (identifier(&field.name), rust_type(&field.ty));
        if let Some(comment) = comment(field) {
            let _ = writeln!(w, "/// {comment}");
        }
        let _ = writeln!(w, "pub {ident}: {ty},");
        let _ = writeln!(
            asserts,
            "assert!(core::mem::offset_of!({name}, {ident}) == {});",
            field.offset
        );
    }
    if let Some(stride) = stride {
        if end.is_some_and(|end| end != stride) {
            return Err(format!(
                "struct {name} has {end:?} bytes but stride {stride}: it holds pointers, end it on 8 bytes"
            ));
        }
        let _ = writeln!(
            asserts,
            "assert!(core::mem::size_of::<{name}>() == {stride});"
        );
    }
    let _ = writeln!(w, "}}\nconst _: () = {{\n{asserts}}};");
    Ok(end.unwrap_or(0))
}

fn rust_type(ty: &Type) -> String {
    match ty {
        Type::F32 => "f32".into(),
        Type::U32 => "u32".into(),
        Type::I32 => "i32".into(),
        Type::Vector(element, count) | Type::Array(element, count) => {
            format!("[{}; {count}]", rust_type(element))
        }
        Type::Struct(name) => format!("crate::kernels::{name}"),
        Type::Pointer {
            pointee,
            writable: true,
        } => format!("crate::gpu::PtrMut<{}>", rust_type(pointee)),
        Type::Pointer {
            pointee,
            writable: false,
        } => format!("crate::gpu::Ptr<{}>", rust_type(pointee)),
    }
}

fn value_text(value: Value) -> String {
    match value {
        Value::F32(v) => v.to_string(),
        Value::U32(v) => v.to_string(),
        Value::I32(v) => v.to_string(),
        Value::Bool(v) => v.to_string(),
    }
}

/// The comment behind a field's declaration in the kernel.
fn field_comment(source: &Source, field: &Field) -> Option<String> {
    let mut lines = source
        .text
        .lines()
        .skip_while(|line| !line.contains("uniform Args"));
    let ending = format!(" {};", field.name);
    let (_, comment) = lines
        .find(|line| {
            line.split("//")
                .next()
                .is_some_and(|code| code.trim_end().ends_with(&ending))
        })?
        .split_once("//")?;
    Some(doc(comment.trim()))
}

/// A comment as rustdoc takes it literally.
fn doc(comment: &str) -> String {
    comment
        .replace('[', "\\[")
        .replace(']', "\\]")
        .replace('<', "\\<")
}

/// A GLSL name as a Rust name.
fn identifier(name: &str) -> String {
    const KEYWORDS: [&str; 12] = [
        "as", "box", "dyn", "final", "fn", "impl", "let", "loop", "match", "mod", "move", "ref",
    ];
    const MORE: [&str; 8] = [
        "trait", "type", "unsafe", "use", "where", "yield", "priv", "pub",
    ];
    match KEYWORDS.contains(&name) || MORE.contains(&name) {
        true => format!("r#{name}"),
        false => name.to_string(),
    }
}
