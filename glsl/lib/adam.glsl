// One step of AdamW with decoupled decay (Loshchilov & Hutter 2019, algorithm 2; Adam where λ is 0), of parameters and their moments.

// Two parameters that lie side by side, and their moments.
struct AdamState {
    vec2 p;
    vec2 m;  // first moments
    vec2 v;  // second moments
};

// What an update is made of, at its own time t.
struct Rates {
    float rate;             // η / (1 − β₁ᵗ)
    float decay;            // η λ
    float correction;       // √(1 − β₂ᵗ)
    float one_minus_beta1;  // numbers of their own, since 1 − 0.999 in float32 is 1e-5 off
    float one_minus_beta2;
    float epsilon;
};

// m ← β₁m + (1 − β₁)g,  v ← β₂v + (1 − β₂)g²,  p ← p − (ηλ p + η m̂/(√v̂ + ε)): one rounding of p, since 1 − ηλ has few digits.
AdamState adam_step(AdamState x, vec2 g, Rates r) {
    vec2 m = fma(vec2(r.one_minus_beta1), g - x.m, x.m);
    vec2 v = fma(vec2(r.one_minus_beta2), g * g - x.v, x.v);
    return AdamState(x.p - fma(vec2(r.decay), x.p, r.rate * m / (sqrt(v) / r.correction + r.epsilon)), m, v);
}
