// AdamW in memory: parameters, gradients and moments in planes of their own.
#include "lib/adam.glsl"
#include "lib/sums.glsl"
#include "lib/half_copy.glsl"
#include "lib/abreast.glsl"

#ifdef DETERMINISTIC
vec2 sums_of(SumsMut grads, uint row, Item pair) { return sums_at(grads, row + 2u * pair.at); }
#else
vec2 sums_of(SumsMut grads, uint row, Item pair) { return pair_of(reading(floats(grads)), row, pair); }
#endif

// The step of a pair of those that begin at an even index `row`; their gradients are consumed. A bad step changes nothing else.
void update_pair(F32sMut params, U32sMut halves, SumsMut grads, F32sMut first_moment, F32sMut second_moment, uint row, Item pair, bool bad, Rates rates) {
    vec2 g = sums_of(grads, row, pair);
    AdamState x = AdamState(pair_of(reading(params), row, pair), pair_of(reading(first_moment), row, pair), pair_of(reading(second_moment), row, pair));
    if (pair.again) return;
    uint i = row + 2u * pair.at;
    clear_pair(grads, i);
    if (bad) return;
    x = adam_step(x, g, rates);
    set_pair(params, i, x.p);
    copy_pair(halves, i, x.p);
    set_pair(first_moment, i, x.m);
    set_pair(second_moment, i, x.v);
}
