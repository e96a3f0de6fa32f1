// One step of AdamW with decoupled decay (Loshchilov & Hutter 2019, algorithm 2; Adam where λ is 0), of a parameter and its moments.
#include "lib/sums.glsl"

struct Moving {
    float p;
    float m;  // first moment
    float v;  // second moment
};

// What an update is made of, at its own time t.
struct Rates {
    float rate;        // η / (1 − β₁ᵗ)
    float decay;       // η λ
    float correction;  // √(1 − β₂ᵗ)
    float share1;      // 1 − β₁, the gradient's share of m: as numbers of their own, since 1 − 0.999 in float32 is 1e-5 off
    float share2;      // 1 − β₂
    float epsilon;
};

// m ← β₁m + (1 − β₁)g,  v ← β₂v + (1 − β₂)g²,  p ← p − (ηλ p + η m̂/(√v̂ + ε)): one rounding of p, since 1 − ηλ has few digits.
Moving adam_step(Moving x, float g, Rates r) {
    float m = fma(r.share1, g - x.m, x.m);
    float v = fma(r.share2, g * g - x.v, x.v);
    return Moving(x.p - fma(r.decay, x.p, r.rate * m / (sqrt(v) / r.correction + r.epsilon)), m, v);
}

// The step of two parameters from an even index i on; their gradients are consumed. A bad step changes nothing else.
void update_pair(F32sMut params, SumsMut grads, F32sMut first_moment, F32sMut second_moment, uint i, bool bad, Rates rates) {
    vec2 g = sums_at(grads, i);
    clear_pair(grads, i);
    if (bad) return;
    vec2 p = pair_at(reading(params), i);
    vec2 m = pair_at(reading(first_moment), i);
    vec2 v = pair_at(reading(second_moment), i);
    [[unroll]] for (uint k = 0u; k < 2u; ++k) {
        Moving x = adam_step(Moving(p[k], m[k], v[k]), g[k], rates);
        p[k] = x.p;
        m[k] = x.m;
        v[k] = x.v;
    }
    set_pair(params, i, p);
    set_pair(first_moment, i, m);
    set_pair(second_moment, i, v);
}
