// What every kernel begins with: extensions, workgroup size, pointer types, the item that this invocation works on.
//
// A kernel includes it before all other files; `#define LOCAL_SIZE n` above that changes the workgroup size. Files are included once,
// however often they are named, so they need no guards.

#extension GL_EXT_buffer_reference2 : require
#extension GL_EXT_buffer_reference_uvec2 : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_EXT_shader_atomic_float : require
#extension GL_EXT_shader_atomic_int64 : require

#ifndef LOCAL_SIZE
#define LOCAL_SIZE 64
#endif
layout(local_size_x = LOCAL_SIZE) in;

// Device pointers. `Mut` may be written; what is only read says so, since the recorder derives its barriers from it.
layout(buffer_reference, scalar, buffer_reference_align = 4) readonly buffer F32s { float at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 4) buffer F32sMut { float at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 4) readonly buffer U32s { uint at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 4) buffer U32sMut { uint at[]; };

// What is only read, of what may be written.
F32s reading(F32sMut p) { return F32s(uvec2(p)); }

// The array from index i on. What is read there at constant indices needs no arithmetic for its addresses: a software device would keep
// each of them on its stack.
#ifdef CORE_ONLY
F32s from(F32s p, uint i) {
    uvec2 address = uvec2(p), bytes;
    uint carry;
    umulExtended(4u, i, bytes.y, bytes.x);
    address.x = uaddCarry(address.x, bytes.x, carry);
    address.y += bytes.y + carry;
    return F32s(address);
}
#else
F32s from(F32s p, uint i) { return F32s(uint64_t(p) + 4ul * i); }
#endif

// A vector of [3, n] numbers: its components lie in planes of n.
vec3 vector_at(F32s planes, uint p, uint n) { return vec3(planes.at[p], planes.at[n + p], planes.at[2u * n + p]); }

void set_vector(F32sMut planes, uint p, uint n, vec3 v) {
    planes.at[p] = v.x;
    planes.at[n + p] = v.y;
    planes.at[2u * n + p] = v.z;
}

// Two neighbours from an even index on, in one access: software devices make one of each component of a vector.
#ifdef CORE_ONLY
vec2 pair_at(F32s p, uint i) { return vec2(p.at[i], p.at[i + 1u]); }

void set_pair(F32sMut p, uint i, vec2 v) {
    p.at[i] = v.x;
    p.at[i + 1u] = v.y;
}

uvec2 words_at(U32s p, uint i) { return uvec2(p.at[i], p.at[i + 1u]); }

void set_words(U32sMut p, uint i, uvec2 v) {
    p.at[i] = v.x;
    p.at[i + 1u] = v.y;
}
#else
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer U64s { uint64_t at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 8) buffer U64sMut { uint64_t at[]; };

vec2 pair_at(F32s p, uint i) { return uintBitsToFloat(unpackUint2x32(U64s(uvec2(p)).at[i >> 1u])); }

void set_pair(F32sMut p, uint i, vec2 v) { U64sMut(uvec2(p)).at[i >> 1u] = packUint2x32(floatBitsToUint(v)); }

uvec2 words_at(U32s p, uint i) { return unpackUint2x32(U64s(uvec2(p)).at[i >> 1u]); }

void set_words(U32sMut p, uint i, uvec2 v) { U64sMut(uvec2(p)).at[i >> 1u] = packUint2x32(v); }
#endif

// Index of this invocation's workgroup among the launch's, which stand in rows: one dimension of a grid ends at 65535 workgroups. For
// kernels that give a workgroup (or a subgroup) one piece of work.
uint group() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

// Index of this invocation among the launch's items. There may be more invocations, so a kernel leaves its body where item() >= n.
uint item() { return group() * gl_WorkGroupSize.x + gl_LocalInvocationID.x; }

// Where an invocation has k items: the first of its subgroup's first items, one for each of its invocations; the next ones follow at
// distances of `items_abreast` (lib/abreast.glsl). A software device takes one subgroup through all of a loop before it begins with the
// next: what a subgroup goes over lies side by side.
// (gl_SubgroupSize is the subgroup's own, and no constant of the device, where pipelines may say so: Pipelines::build.)
uint items_abreast() { return min(gl_SubgroupSize, LOCAL_SIZE); }
uint first_of_subgroup(uint k) { return (group() * gl_NumSubgroups + gl_SubgroupID) * k * items_abreast(); }

// The launch's second dimension (Work::slices): level, layer, axis.
uint slice() { return gl_WorkGroupID.z; }
