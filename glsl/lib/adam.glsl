// One step of AdamW with decoupled decay (Loshchilov & Hutter 2019, algorithm 2; Adam where λ is 0), of a parameter and its moments.

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
