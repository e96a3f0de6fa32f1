// An entry of a lazy table brought up to date. The including kernel's arguments come first: the table, its copy, gradients, moments, stamps, rows
// of the clock, and what an update is made of.

// An entry's stamp becomes another: the word in which it lies, as it was read, and what of that changes. Several invocations may have
// entries whose stamps share a word; the kernel knows.
void restamp(uint slot, uint of_four, uint change);

// A pair of an entry's features after the update with gradient g and what they missed since.
void settle_pair(uint entry, uint k, AdamState x, vec2 g, ClockRow row, uint next, uint now, Rates rates) {
    x = adam_step(x, g, rates);
    vec2 p = caught_up(x, row.lag, rows, next, now, rates);
    store_features(table, entry, k, p);
    copy_pair(halves, entry * FEATURES + 2u * k, p);
    store_features(first_moment, entry, k, row.lag.first * x.m);
    store_features(second_moment, entry, k, row.lag.second * x.v);
    clear_sums(grads, entry, k);
}

// The update that an entry's gradient has been waiting for, then those that it missed.
void settle(uint entry, uint slot, uint now) {
    // All is asked for before any of it is looked at: waiting for memory is what this costs.
    uint of_four = stamps.at[slot >> 2u];
    AdamState x[PAIRS];
    vec2 g[PAIRS];
    [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
        x[k] = AdamState(load_features(reading(table), entry, k), load_features(reading(first_moment), entry, k),
                         load_features(reading(second_moment), entry, k));
        g[k] = load_sums(grads, entry, k);
    }
    uint stamp = stamp_in(of_four, slot);
    if (stamp == now) return;
    uint next = (stamp + 1u) % READINGS;
    ClockRow row = row_of(rows, next);
    Rates rates = Rates(row.rate, row.decay, row.correction, one_minus_beta1, one_minus_beta2, epsilon);
    if (next == now) row.lag = NO_LAG;
    // (Written out: a loop around a loop stays one, and what it indexes goes through memory lane by lane.)
    settle_pair(entry, 0u, x[0], g[0], row, next, now, rates);
    if (PAIRS > 1u) settle_pair(entry, 1u, x[min(1u, PAIRS - 1u)], g[min(1u, PAIRS - 1u)], row, next, now, rates);
    if (PAIRS > 2u) settle_pair(entry, 2u, x[min(2u, PAIRS - 1u)], g[min(2u, PAIRS - 1u)], row, next, now, rates);
    if (PAIRS > 3u) settle_pair(entry, 3u, x[min(3u, PAIRS - 1u)], g[min(3u, PAIRS - 1u)], row, next, now, rates);
    restamp(slot, of_four, (stamp ^ now) << (8u * (slot & 3u)));
}
