// AdamW in memory: parameters, gradients and moments in planes of their own.
#include "lib/adam.glsl"
#include "lib/sums.glsl"
#include "lib/half_copy.glsl"

// The step of two parameters from an even index i on; their gradients are consumed. A bad step changes nothing else.
void update_pair(F32sMut params, U32sMut halves, SumsMut grads, F32sMut first_moment, F32sMut second_moment, uint i, bool bad, Rates rates) {
    vec2 g = sums_at(grads, i);
    clear_pair(grads, i);
    if (bad) return;
    AdamState x = AdamState(pair_at(reading(params), i), pair_at(reading(first_moment), i), pair_at(reading(second_moment), i));
    x = adam_step(x, g, rates);
    set_pair(params, i, x.p);
    copy_pair(halves, i, x.p);
    set_pair(first_moment, i, x.m);
    set_pair(second_moment, i, x.v);
}
