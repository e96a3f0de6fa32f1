// A hash table under AdamW of which a step only changes the entries that it needs, and which still is what AdamW makes of it.
//
// A clock counts updates; an entry's stamp is the clock's reading when a step last asked for it. The gradient of that step stays where it
// is until the entry is asked for again, and so does its update: then both are made at once, that one and those without gradient that
// followed it (table_settle). Those are linear in an entry's parameter and moments as long as ε is small against √v. So k of them are, with
// p, m and v after the update,
//     p ← p − (E p + S m / (√v + ε b)),   m ← β₁ᵏ m,   v ← β₂ᵏ v
//     E = 1 − Π_j (1 − η_j λ),   S = Σ_j s_j,   s_j = η_j c2_j/c1_j (β₁/√β₂)^j Π_{i>j} (1 − η_i λ),   b = Σ_j s_j c2_j β₂^{−j/2} / S
// with the bias corrections c1 = 1 − β₁ᵗ, c2 = √(1 − β₂ᵗ). E, S, b and the powers are the same for all entries that stand at one reading,
// and lie in a row for each. Clock and stamps count modulo 256: nothing is left alone for as many steps (table_settle sweeps).
//
// A level is marked entry by entry before a step reads it. Where so much of it turns out to be needed that going over all is cheaper, it is
// brought up to date, and `whole` for some steps: then it is updated whole, and needs neither marks nor stamps. The last of them marks it
// again, to see whether it still is.
#include "lib/adam.glsl"

const uint READINGS = 256u;
const uint WHOLE = 64u;  // steps for which a level becomes whole

// What an entry has missed.
struct Lag {
    float decay;     // E
    float momentum;  // S
    float slowing;   // b
    float first;     // β₁ᵏ
    float second;    // β₂ᵏ
};
const Lag NO_LAG = Lag(0.0, 0.0, 0.0, 1.0, 1.0);

// Of a reading of the clock: what entries that stood there have missed by now, and the update that ended with it.
struct ClockRow {
    Lag lag;
    float rate;
    float decay;
    float correction;
};
layout(buffer_reference, scalar) readonly buffer ClockRows { ClockRow at[]; };

// A row, whose eight numbers lanes read from all over: in pairs, half as many accesses.
ClockRow row_of(ClockRows rows, uint then) {
    F32s numbers = F32s(uvec2(rows));
    vec2 pairs[4];
    [[unroll]] for (uint k = 0u; k < 4u; ++k) pairs[k] = pair_at(numbers, 8u * then + 2u * k);
    return ClockRow(Lag(pairs[0].x, pairs[0].y, pairs[1].x, pairs[1].y, pairs[2].x), pairs[2].y, pairs[3].x, pairs[3].y);
}

struct LevelUse {
    uint marked;  // entries, in this step
    uint whole;   // non-zero: steps for which it is updated whole
};
layout(buffer_reference, scalar) readonly buffer LevelUses { LevelUse at[]; };
layout(buffer_reference, scalar) buffer LevelUsesMut { LevelUse at[]; };

// Marks (a bit each) and stamps (a byte each) are kept by slots: entries, but every level begins with a pair of words of marks of its own.
uint first_slot(Level level, uint l) { return (level.offset / 64u + l) * 64u; }

uint stamp_in(uint word, uint slot) { return (word >> (8u * (slot & 3u))) & 255u; }

// p of an entry that stands at a reading `then`, with its lag, as it should be at `now`.
vec2 caught_up(AdamState x, Lag lag, ClockRows rows, uint then, uint now, Rates r) {
    float slowing = r.epsilon * lag.slowing;
    vec2 inverse = 1.0 / max(sqrt(x.v) + slowing, 1e-37);
    vec2 moved = lag.momentum * x.m * inverse;
    // The mean b stands for all b_j as long as ε is small. What is neglected is (ε b/(√v + ε b))² of the move, times the relative variance
    // of the b_j: a tenth, if both the first steps and the longest lags are in it. Where that could matter: step by step.
    vec2 small = slowing * inverse;
    vec2 neglected = abs(moved) * small * small;
    if (max(neglected.x, neglected.y) > 2e-7) {
        for (uint k = then; k != now; k = (k + 1u) % READINGS) {
            ClockRow next = rows.at[(k + 1u) % READINGS];
            x = adam_step(x, vec2(0.0),
                          Rates(next.rate, next.decay, next.correction, r.one_minus_beta1, r.one_minus_beta2, r.epsilon));
        }
        return x.p;
    }
    return x.p - fma(vec2(lag.decay), x.p, moved);
}
