// Gradients are sums, to which any number of invocations add. Floats then depend on the order, in their last digits; DETERMINISTIC keeps
// integers in units of 2⁻⁴⁸, which do not: up to ±32768, 3.6e-15 apart. `add_alone` is for who knows that nobody else adds there.
#ifdef DETERMINISTIC
layout(buffer_reference, scalar, buffer_reference_align = 8) buffer SumsMut { int64_t at[]; };
const uint SUM_WORDS = 2u;
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
const uint SUM_WORDS = 1u;

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
