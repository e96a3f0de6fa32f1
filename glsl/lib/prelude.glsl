// What every kernel begins with: extensions, workgroup size, pointer types, the item that this invocation works on.
//
// A kernel's first line is `#version 460`, its second includes this file; `#define LOCAL_SIZE n` between the two changes the workgroup
// size. Files are included once, however often they are named, so they need no guards.

#extension GL_EXT_buffer_reference2 : require
#extension GL_EXT_buffer_reference_uvec2 : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
#extension GL_EXT_shader_atomic_float : require

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

// Two neighbours from an even index on, in one access: software devices make one of each component of a vector.
#ifdef CORE_ONLY
vec2 pair_at(F32s p, uint i) { return vec2(p.at[i], p.at[i + 1u]); }

void set_pair(F32sMut p, uint i, vec2 v) {
    p.at[i] = v.x;
    p.at[i + 1u] = v.y;
}
#else
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer U64s { uint64_t at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 8) buffer U64sMut { uint64_t at[]; };

vec2 pair_at(F32s p, uint i) { return uintBitsToFloat(unpackUint2x32(U64s(uvec2(p)).at[i >> 1u])); }

void set_pair(F32sMut p, uint i, vec2 v) { U64sMut(uvec2(p)).at[i >> 1u] = packUint2x32(floatBitsToUint(v)); }
#endif

// Index of this invocation among the launch's items, in rows of 256 workgroups: one dimension of a grid ends at 65535 workgroups.
// The last row is ragged, so a kernel leaves its body where item() >= n.
uint item() { return (gl_WorkGroupID.y * 256u + gl_WorkGroupID.x) * gl_WorkGroupSize.x + gl_LocalInvocationID.x; }

// Index of this invocation's workgroup among them; for kernels that give a workgroup (or a subgroup) one piece of work.
uint group() { return gl_WorkGroupID.y * 256u + gl_WorkGroupID.x; }

// The launch's second dimension (Work::slices): level, layer, axis.
uint slice() { return gl_WorkGroupID.z; }

// Gradients are sums, to which any number of invocations add. Floats then depend on the order, in their last digits; DETERMINISTIC keeps
// integers in units of 2⁻⁴⁸, which do not: up to ±32768, 3.6e-15 apart. `add_alone` is for who knows that nobody else adds there.
#ifdef DETERMINISTIC
#extension GL_EXT_shader_atomic_int64 : require
layout(buffer_reference, scalar, buffer_reference_align = 8) buffer SumsMut { int64_t at[]; };
const float UNITS = 281474976710656.0;

void add(SumsMut p, uint i, float v) { atomicAdd(p.at[i], int64_t(v * UNITS)); }

float sum_at(SumsMut p, uint i) { return float(p.at[i]) / UNITS; }

void clear(SumsMut p, uint i) { p.at[i] = 0; }

vec2 sums_at(SumsMut p, uint i) { return vec2(sum_at(p, i), sum_at(p, i + 1u)); }

void clear_pair(SumsMut p, uint i) {
    clear(p, i);
    clear(p, i + 1u);
}

void add_alone(SumsMut p, uint i, float v) { p.at[i] += int64_t(v * UNITS); }

void add_pair_alone(SumsMut p, uint i, vec2 v) {
    add_alone(p, i, v.x);
    add_alone(p, i + 1u, v.y);
}
#else
layout(buffer_reference, scalar, buffer_reference_align = 4) buffer SumsMut { float at[]; };

F32sMut floats(SumsMut p) { return F32sMut(uvec2(p)); }

// Without the extension: compare and swap until nobody came between.
void add(SumsMut p, uint i, float v) {
#ifdef CORE_ONLY
    U32sMut bits = U32sMut(uvec2(p));
    uint seen = bits.at[i];
    uint expected;
    do {
        expected = seen;
        seen = atomicCompSwap(bits.at[i], expected, floatBitsToUint(uintBitsToFloat(expected) + v));
    } while (seen != expected);
#else
    atomicAdd(p.at[i], v);
#endif
}

float sum_at(SumsMut p, uint i) { return p.at[i]; }

void clear(SumsMut p, uint i) { p.at[i] = 0.0; }

vec2 sums_at(SumsMut p, uint i) { return pair_at(reading(floats(p)), i); }

void clear_pair(SumsMut p, uint i) { set_pair(floats(p), i, vec2(0.0)); }

void add_alone(SumsMut p, uint i, float v) { p.at[i] += v; }

void add_pair_alone(SumsMut p, uint i, vec2 v) { set_pair(floats(p), i, sums_at(p, i) + v); }
#endif
