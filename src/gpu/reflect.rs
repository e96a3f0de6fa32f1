//! What a compiled kernel says about itself: push-constant block, pointers, specialisation constants, workgroup size.
//!
//! A walk over the SPIR-V words (SPIR-V 1.5 specification, section 3), shared by build.rs, which writes the Rust twins from it, and by
//! the tests. Only what the kernels' rules allow is understood (one push-constant block named `Args`, device pointers declared with
//! `buffer_reference`, numbers, vectors, arrays and structures of them); everything else is refused by name.

use std::collections::{BTreeMap, HashMap, HashSet};

/// A type that host and device share.
#[derive(Clone, Debug, PartialEq)]
pub enum Type {
    F32,
    U32,
    I32,
    Vector(Box<Type>, u32),
    Array(Box<Type>, u32),
    Struct(String),
    Pointer { pointee: Box<Type>, writable: bool },
}

/// A member of the push-constant block or of a structure behind a pointer.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    pub name: String,
    pub offset: u32,
    pub ty: Type,
}

/// A structure behind a pointer.
#[derive(Clone, Debug, PartialEq)]
pub struct Struct {
    pub fields: Vec<Field>,
    /// Distance of one array element to the next, where the structure is an array's element.
    pub stride: Option<u32>,
}

/// Default of a specialisation constant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    F32(f32),
    U32(u32),
    I32(i32),
    Bool(bool),
}

/// A specialisation constant.
#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    pub id: u32,
    pub name: String,
    pub default: Value,
}

/// Everything the host needs to know of one kernel.
#[derive(Clone, Debug, PartialEq)]
pub struct Module {
    pub local_size: [u32; 3],
    /// The push-constant block, by offset.
    pub args: Vec<Field>,
    /// Structures behind the block's pointers, by name.
    pub structs: BTreeMap<String, Struct>,
    /// Specialisation constants, by id.
    pub constants: Vec<Constant>,
    /// Adds to floats in memory atomically (capability AtomicFloat32AddEXT), or uses 64-bit integers: Vulkan 1.2 has them on some devices.
    pub beyond_core: bool,
    /// Multiplies by cooperative matrices.
    pub cooperative: bool,
    /// Reads through pointers that are not members of the block: found in memory, or computed.
    pub indirect_reads: bool,
    /// Writes through such pointers.
    pub indirect_writes: bool,
}

/// Functions of glsl/lib/prelude.glsl and sums.glsl, as glslang names them, that look at an argument of theirs in another way: the pointers that they make
/// lead nowhere new.
const VIEWS: [&str; 5] = ["reading(", "floats(", "pair_at(", "set_pair(", "add("];
const CAPABILITY_INT64: u32 = 11;
const CAPABILITY_ATOMIC_FLOAT32_ADD: u32 = 6033;
const CAPABILITY_COOPERATIVE_MATRIX: u32 = 6022;
const DECORATION_SPEC_ID: u32 = 1;
const DECORATION_ARRAY_STRIDE: u32 = 6;
const DECORATION_BUILT_IN: u32 = 11;
const DECORATION_NON_WRITABLE: u32 = 24;
const DECORATION_OFFSET: u32 = 35;
const BUILT_IN_WORKGROUP_SIZE: u32 = 25;
const STORAGE_PUSH_CONSTANT: u32 = 9;
const STORAGE_PHYSICAL: u32 = 5349;

#[derive(Clone, Debug)]
enum Raw {
    Bool,
    Int { width: u32, signed: bool },
    Float { width: u32 },
    Vector { element: u32, count: u32 },
    Array { element: u32, count: u32 },
    RuntimeArray { element: u32 },
    Struct { members: Vec<u32> },
    Pointer { storage: u32, pointee: u32 },
    Matrix,
}

/// The module's tables, as they are read.
#[derive(Default)]
struct Words {
    names: HashMap<u32, String>,
    member_names: HashMap<(u32, u32), String>,
    types: HashMap<u32, Raw>,
    constants: HashMap<u32, u32>,
    offsets: HashMap<(u32, u32), u32>,
    non_writable: HashSet<(u32, u32)>,
    strides: HashMap<u32, u32>,
}

impl Module {
    /// Reads a module; `Err` says what is not allowed.
    pub fn read(spirv: &[u32]) -> Result<Module, String> {
        if spirv.len() < 5 || spirv[0] != 0x0723_0203 {
            return Err("not a SPIR-V module".into());
        }
        let mut words = Words::default();
        let mut spec_ids: HashMap<u32, u32> = HashMap::new();
        let mut spec_values: Vec<(u32, u32, Option<u32>)> = Vec::new(); // (id, type or 0/1 for bool, word)
        let mut local_size = None;
        let mut workgroup_size_id = None;
        let mut push_block = None;
        let mut capabilities = HashSet::new();
        let mut made_pointers = HashSet::new();
        let mut in_view = false;
        let mut spec_composites = HashSet::new();
        let mut at = 5;
        while at < spirv.len() {
            let (count, op) = ((spirv[at] >> 16) as usize, spirv[at] & 0xffff);
            if count == 0 || at + count > spirv.len() {
                return Err("a SPIR-V instruction runs past the module's end".into());
            }
            let w = &spirv[at..at + count];
            match op {
                5 => drop(words.names.insert(w[1], literal(&w[2..]))),
                6 => drop(words.member_names.insert((w[1], w[2]), literal(&w[3..]))),
                16 if w[2] == 17 => local_size = Some([w[3], w[4], w[5]]),
                17 => drop(capabilities.insert(w[1])),
                20 => drop(words.types.insert(w[1], Raw::Bool)),
                21 => {
                    let (width, signed) = (w[2], w[3] == 1);
                    words.types.insert(w[1], Raw::Int { width, signed });
                }
                22 => drop(words.types.insert(w[1], Raw::Float { width: w[2] })),
                23 => {
                    let (element, count) = (w[2], w[3]);
                    words.types.insert(w[1], Raw::Vector { element, count });
                }
                24 => drop(words.types.insert(w[1], Raw::Matrix)),
                28 => {
                    let (element, count) = (w[2], w[3]);
                    words.types.insert(w[1], Raw::Array { element, count });
                }
                29 => drop(
                    words
                        .types
                        .insert(w[1], Raw::RuntimeArray { element: w[2] }),
                ),
                30 => {
                    let members = w[2..].to_vec();
                    words.types.insert(w[1], Raw::Struct { members });
                }
                32 => {
                    let (storage, pointee) = (w[2], w[3]);
                    words.types.insert(w[1], Raw::Pointer { storage, pointee });
                }
                43 => drop(words.constants.insert(w[2], w[3])),
                48 => spec_values.push((w[2], 1, None)),
                49 => spec_values.push((w[2], 0, None)),
                50 => spec_values.push((w[2], w[1], Some(w[3]))),
                51 => drop(spec_composites.insert(w[2])),
                59 if w[3] == STORAGE_PUSH_CONSTANT => push_block = Some(w[1]),
                71 if w[2] == DECORATION_SPEC_ID => drop(spec_ids.insert(w[1], w[3])),
                71 if w[2] == DECORATION_ARRAY_STRIDE => drop(words.strides.insert(w[1], w[3])),
                71 if w[2] == DECORATION_BUILT_IN && w[3] == BUILT_IN_WORKGROUP_SIZE => {
                    workgroup_size_id = Some(w[1]);
                }
                72 if w[3] == DECORATION_OFFSET => {
                    words.offsets.insert((w[1], w[2]), w[4]);
                }
                72 if w[3] == DECORATION_NON_WRITABLE => {
                    words.non_writable.insert((w[1], w[2]));
                }
                54 => {
                    let name = words.names.get(&w[2]).map_or("", String::as_str);
                    in_view = VIEWS.iter().any(|view| name.starts_with(view));
                }
                120 | 124 if !in_view => drop(made_pointers.insert(w[1])),
                _ => {}
            }
            at += count;
        }
        if workgroup_size_id.is_some_and(|id| spec_composites.contains(&id)) {
            return Err(
                "the workgroup size must be a number, not a specialisation constant".into(),
            );
        }

        let mut constants = Vec::new();
        for (id, ty, word) in spec_values {
            let Some(&spec_id) = spec_ids.get(&id) else {
                continue; // derived from others
            };
            let name = words.names.get(&id).cloned().unwrap_or_default();
            let default = match (word, words.types.get(&ty)) {
                (None, _) => Value::Bool(ty == 1),
                (Some(word), Some(Raw::Float { width: 32 })) => Value::F32(f32::from_bits(word)),
                (Some(word), Some(Raw::Int { width: 32, signed })) => match signed {
                    true => Value::I32(word as i32),
                    false => Value::U32(word),
                },
                _ => {
                    return Err(format!(
                        "specialisation constant {name}: only uint, int, float, bool"
                    ));
                }
            };
            constants.push(Constant {
                id: spec_id,
                name,
                default,
            });
        }
        constants.sort_by_key(|constant| constant.id);

        let mut structs = BTreeMap::new();
        let push_block = push_block.ok_or("no push-constant block")?;
        let Some(&Raw::Pointer { pointee, .. }) = words.types.get(&push_block) else {
            return Err("the push-constant variable is no pointer".into());
        };
        if words.names.get(&pointee).is_none_or(|name| name != "Args") {
            return Err("the push-constant block must be named Args".into());
        }
        let args = words.fields(pointee, &mut structs)?;
        let mut module = Module {
            local_size: local_size.ok_or("no workgroup size")?,
            args,
            structs,
            constants,
            beyond_core: capabilities.contains(&CAPABILITY_ATOMIC_FLOAT32_ADD)
                || capabilities.contains(&CAPABILITY_INT64),
            cooperative: capabilities.contains(&CAPABILITY_COOPERATIVE_MATRIX),
            indirect_reads: false,
            indirect_writes: false,
        };
        let behind = module
            .structs
            .values()
            .flat_map(|s| &s.fields)
            .filter_map(|field| innermost_pointer(&field.ty));
        let mut indirect: Vec<bool> = behind.collect();
        for ty in made_pointers {
            if let Some(&Raw::Pointer {
                storage: STORAGE_PHYSICAL,
                pointee,
            }) = words.types.get(&ty)
            {
                indirect.push(words.writable(pointee));
            }
        }
        module.indirect_reads = !indirect.is_empty();
        module.indirect_writes = indirect.contains(&true);
        Ok(module)
    }
}

/// Whether a pointer inside `ty` is writable; `None` where there is no pointer.
fn innermost_pointer(ty: &Type) -> Option<bool> {
    match ty {
        Type::Pointer { writable, .. } => Some(*writable),
        Type::Array(element, _) => innermost_pointer(element),
        _ => None,
    }
}

impl Words {
    /// A block behind a pointer may be written unless every member is readonly. A type that is no block came from a computed address.
    fn writable(&self, block: u32) -> bool {
        match self.types.get(&block) {
            Some(Raw::Struct { members }) => (0..members.len() as u32)
                .any(|member| !self.non_writable.contains(&(block, member))),
            _ => true,
        }
    }

    fn fields(
        &self,
        id: u32,
        structs: &mut BTreeMap<String, Struct>,
    ) -> Result<Vec<Field>, String> {
        let Some(Raw::Struct { members }) = self.types.get(&id) else {
            return Err("a block must be a structure".into());
        };
        let block = self.names.get(&id).cloned().unwrap_or_default();
        let mut fields = Vec::new();
        for (member, &ty) in members.iter().enumerate() {
            let key = (id, member as u32);
            let name = self.member_names.get(&key).cloned().unwrap_or_default();
            let place = format!("{block}.{name}");
            let offset = *self
                .offsets
                .get(&key)
                .ok_or(format!("{place} has no offset"))?;
            let ty = self.shared_type(ty, &place, structs)?;
            fields.push(Field { name, offset, ty });
        }
        Ok(fields)
    }

    fn shared_type(
        &self,
        id: u32,
        place: &str,
        structs: &mut BTreeMap<String, Struct>,
    ) -> Result<Type, String> {
        let raw = self
            .types
            .get(&id)
            .ok_or(format!("{place}: unknown type"))?;
        Ok(match *raw {
            Raw::Float { width: 32 } => Type::F32,
            Raw::Int {
                width: 32,
                signed: false,
            } => Type::U32,
            Raw::Int {
                width: 32,
                signed: true,
            } => Type::I32,
            Raw::Vector { element, count } => {
                Type::Vector(Box::new(self.shared_type(element, place, structs)?), count)
            }
            Raw::Array { element, count } => {
                let count = *self
                    .constants
                    .get(&count)
                    .ok_or(format!("{place}: an array's length must be a number"))?;
                let ty = self.shared_type(element, place, structs)?;
                self.note_stride(id, &ty, place, structs)?;
                Type::Array(Box::new(ty), count)
            }
            Raw::Struct { .. } => {
                let name = self.names.get(&id).cloned().unwrap_or_default();
                if !structs.contains_key(&name) {
                    let fields = self.fields(id, structs)?;
                    structs.insert(
                        name.clone(),
                        Struct {
                            fields,
                            stride: None,
                        },
                    );
                }
                Type::Struct(name)
            }
            Raw::Pointer {
                storage: STORAGE_PHYSICAL,
                pointee,
            } => {
                let writable = self.writable(pointee);
                let pointee = Box::new(self.pointee(pointee, place, structs)?);
                Type::Pointer { pointee, writable }
            }
            _ => {
                return Err(format!(
                    "{place}: only pointers, float, uint, int, vectors, arrays and structures of them"
                ));
            }
        })
    }

    /// `buffer F32s { float at[]; }` points to floats; a block of several members, or of one that is no open array, to itself.
    fn pointee(
        &self,
        block: u32,
        place: &str,
        structs: &mut BTreeMap<String, Struct>,
    ) -> Result<Type, String> {
        if let Some(Raw::Struct { members }) = self.types.get(&block)
            && let [only] = members[..]
            && let Some(&Raw::RuntimeArray { element }) = self.types.get(&only)
        {
            let ty = self.shared_type(element, place, structs)?;
            self.note_stride(only, &ty, place, structs)?;
            return Ok(ty);
        }
        self.shared_type(block, place, structs)
    }

    fn note_stride(
        &self,
        array: u32,
        element: &Type,
        place: &str,
        structs: &mut BTreeMap<String, Struct>,
    ) -> Result<(), String> {
        let stride = *self
            .strides
            .get(&array)
            .ok_or(format!("{place}: an array without stride"))?;
        match element {
            Type::Struct(name) => {
                if let Some(known) = structs.get_mut(name) {
                    known.stride = Some(stride);
                }
            }
            other if other.size() != Some(stride) => {
                return Err(format!(
                    "{place}: array stride {stride}; declare the block with layout(scalar)"
                ));
            }
            _ => {}
        }
        Ok(())
    }
}

impl Type {
    /// Bytes, in scalar layout; `None` for a structure.
    pub fn size(&self) -> Option<u32> {
        Some(match self {
            Type::F32 | Type::U32 | Type::I32 => 4,
            Type::Pointer { .. } => 8,
            Type::Vector(element, count) | Type::Array(element, count) => element.size()? * count,
            Type::Struct(_) => return None,
        })
    }
}

/// A string packed into words, up to its zero.
fn literal(words: &[u32]) -> String {
    let bytes: Vec<u8> = words
        .iter()
        .flat_map(|word| word.to_le_bytes())
        .take_while(|&byte| byte != 0)
        .collect();
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::KernelShape;

    fn read(spirv: &[u8]) -> Module {
        Module::read(&bytemuck::pod_collect_to_vec::<u8, u32>(spirv)).expect("an embedded kernel")
    }

    #[test]
    fn fill_is_what_its_glsl_declares() {
        let module = read(crate::kernels::fill::Shape::module().spirv);
        let field = |name: &str, offset, ty| Field {
            name: name.into(),
            offset,
            ty,
        };
        let values = Type::Pointer {
            pointee: Box::new(Type::F32),
            writable: true,
        };
        let args = [
            field("values", 0, values),
            field("n", 8, Type::U32),
            field("value", 12, Type::F32),
        ];
        assert_eq!(module.args, args);
        assert_eq!(module.local_size, [64, 1, 1]);
        assert_eq!(module.constants, []);
        assert!(!module.indirect_reads && !module.beyond_core);
    }

    #[test]
    fn what_is_no_module_is_refused() {
        assert!(Module::read(&[]).is_err());
        assert!(Module::read(&[0x0723_0203, 0x0001_0500, 0, 1, 0, 0xffff_0005]).is_err());
    }
}
