#version 460
// AdamW of the hash table: of the marked entries of a level (the slice), or of all where most are marked. One workgroup for a block of
// entries. Gradients, marks and stamps are consumed in passing. A step whose loss is not finite changes nothing.
// Every block is gone over as a whole once in so many steps, so that no entry is left alone for as long as stamps can count.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint FEATURES = 2;

layout(push_constant, scalar) uniform Args {
    Levels levels;
    LevelUses uses;         // [levels]
    Lags lags;              // [256]
    U32s clock;             // [1]
    U32s bad_step;          // [1] non-zero: losses not finite
    F32sMut table;          // [entries, FEATURES]
    F32sMut grads;          // [entries, FEATURES] zero where nobody marked
    F32sMut first_moment;   // [entries, FEATURES]
    F32sMut second_moment;  // [entries, FEATURES]
    U32sMut marks;          // [slots / 32] a bit each
    U32sMut stamps;         // [slots / 4] a byte each
    float rate;             // η / (1 − β₁ᵗ)
    float decay;            // η λ
    float correction;       // √(1 − β₂ᵗ)
    float share1;         // 1 − β₁
    float share2;         // 1 − β₂
    float epsilon;
    uint step;
};

const uint SWEEP = 240u;  // steps
const uint TURN = 8u;  // parameters of an invocation in one turn of a loop

shared uint listed[BLOCK / 2u];  // more of a block are gone over as a whole
shared uint n_listed;

uint now, next;
bool bad;
Rates rates;

// The update of parameter i, whose entry is up to date.
void update(uint i) {
    float g = grads.at[i];
    grads.at[i] = 0.0;
    if (bad) return;
    Moving x = adam_step(Moving(table.at[i], first_moment.at[i], second_moment.at[i]), g, rates);
    table.at[i] = x.p;
    first_moment.at[i] = x.m;
    second_moment.at[i] = x.v;
}

// The update of an entry whose moments are as old as its stamp, and p is too, unless it is marked.
void update_stale(uint entry, uint slot, bool marked) {
    uint stamp = stamp_in(stamps.at[slot >> 2u], slot);
    Lag lag = NO_LAG;
    if (stamp != now) lag = lags.at[stamp];
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
        uint i = entry * FEATURES + f;
        Moving x = Moving(table.at[i], first_moment.at[i], second_moment.at[i]);
        if (!marked) x.p = caught_up(x, lag, lags, stamp, now, rates);
        x.m *= lag.first;
        x.v *= lag.second;
        float g = grads.at[i];
        if (marked) grads.at[i] = 0.0;
        if (!bad) x = adam_step(x, g, rates);
        table.at[i] = x.p;
        first_moment.at[i] = x.m;
        second_moment.at[i] = x.v;
    }
    // Turns the old stamp's byte into the new one's and leaves its neighbours alone.
    atomicXor(stamps.at[slot >> 2u], (stamp ^ next) << (8u * (slot & 3u)));
}

void main() {
    uint l = slice();
    Level level = levels.at[l];
    LevelUse use = uses.at[l];
    uint block = group(), lane = gl_LocalInvocationID.x;
    if (block * BLOCK >= level.entries) return;
    uint first = level.offset + block * BLOCK;
    uint n_entries = min(BLOCK, level.entries - block * BLOCK);
    uint slots = first_slot(level, l) + block * BLOCK;
    now = clock.at[0];
    bad = bad_step.at[0] != 0u;
    next = bad ? now : (now + 1u) % READINGS;
    rates = Rates(rate, decay, correction, share1, share2, epsilon);

    if (use.whole != 0u) {
        uint n_params = n_entries * FEATURES;
        for (uint j = lane; j < n_params; j += TURN * LOCAL_SIZE) {
            [[unroll]] for (uint k = 0u; k < TURN; ++k) {
                if (j + k * LOCAL_SIZE < n_params) update(first * FEATURES + j + k * LOCAL_SIZE);
            }
        }
        // The next step marks this level again, and needs its stamps.
        if (use.whole == 1u) {
            for (uint word = lane; word < BLOCK / 4u; word += LOCAL_SIZE) stamps.at[slots / 4u + word] = next * 0x01010101u;
        }
        return;
    }

    bool all = mostly_touched(level, use.touched) || block % SWEEP == step % SWEEP;
    if (!all) {
        if (lane == 0u) n_listed = 0u;
        barrier();
        for (uint word = lane; word < BLOCK / 32u; word += LOCAL_SIZE) {
            uint bits = marks.at[slots / 32u + word];
            uint at = atomicAdd(n_listed, bitCount(bits));
            if (at + bitCount(bits) > BLOCK / 2u) continue;
            for (; bits != 0u; bits &= bits - 1u) listed[at++] = word * 32u + findLSB(bits);
        }
        barrier();
        all = n_listed > BLOCK / 2u;
    }
    if (all) {
        for (uint e = lane; e < n_entries; e += LOCAL_SIZE) {
            uint slot = slots + e;
            update_stale(first + e, slot, (marks.at[slot >> 5u] >> (slot & 31u) & 1u) != 0u);
        }
    } else {
        for (uint k = lane; k < n_listed; k += LOCAL_SIZE) update_stale(first + listed[k], slots + listed[k], true);
    }
    barrier();
    for (uint word = lane; word < BLOCK / 32u; word += LOCAL_SIZE) marks.at[slots / 32u + word] = 0u;
}
