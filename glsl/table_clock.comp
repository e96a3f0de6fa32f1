#version 460
// Lets the table's clock go on by an update, after it: what entries of each stamp have missed, and which levels the next steps mark. ONE
// workgroup, an invocation for each of the clock's readings.
#define LOCAL_SIZE 256
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;

layout(buffer_reference, scalar) buffer ClockRowsMut { ClockRow at[]; };

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s bad_step;         // [1] non-zero: there was no update
    LevelUsesMut uses;     // [LEVELS]
    ClockRowsMut rows;     // [256]
    U32sMut clock;         // [1]
    float rate;            // η / (1 − β₁ᵗ)
    float decay;           // η λ
    float correction;      // √(1 − β₂ᵗ)
    float one_minus_beta1; // 1 − β₁
    float one_minus_beta2; // 1 − β₂
    float most;            // share of a level's entries
};

void main() {
    uint row = gl_LocalInvocationID.x;
    uint now = clock.at[0];
    bool bad = bad_step.at[0] != 0u;
    // Everybody has read the clock before it goes on: by itself, a barrier orders shared memory alone.
    memoryBarrierBuffer();
    barrier();
    if (row < LEVELS) {
        LevelUse use = uses.at[row];
        uint whole = use.whole - 1u;
        if (use.whole <= 1u) {
            bool mostly = float(use.marked) > most * float(levels.at[row].entries);
            // One that stays whole has nothing to be brought up to date, which WHOLE would ask for.
            whole = mostly ? WHOLE - use.whole : 0u;
        }
        uses.at[row] = LevelUse(0u, whole);
    }
    if (bad) return;
    uint next = (now + 1u) % READINGS;
    if (row == 0u) clock.at[0] = next;
    if (row == next) {
        rows.at[row].rate = rate;
        rows.at[row].decay = decay;
        rows.at[row].correction = correction;
        return;
    }
    Lag lag = NO_LAG; // who stands at the clock has missed nothing yet
    if (row != now) lag = rows.at[row].lag;
    lag.first -= one_minus_beta1 * lag.first;
    lag.second -= one_minus_beta2 * lag.second;
    float root = sqrt(lag.second);
    float kept = lag.momentum - decay * lag.momentum;
    float added = rate * correction * lag.first / root;
    float slowed = kept * lag.slowing + added * correction / root;
    lag.decay += decay - decay * lag.decay;
    lag.momentum = kept + added;
    lag.slowing = lag.momentum > 0.0 ? slowed / lag.momentum : 0.0;
    rows.at[row].lag = lag;
}
