// Whether a kernel's products are straight-line code, with no loop and no branch around them. Inside of one, Mesa 22.3's software device
// branches per lane at every load; outside it loads a weight once for all lanes, and is ten times faster. Its successors make the better
// code of loops. Forms::of measures which; wide networks are loops in any case, since they would take too long to compile.

// The iterations of a loop with [[unroll]]: always `count`. With STRAIGHT that is a constant, and the loop is unrolled. Without, it is
// computed from an argument `n` that is never 0, so that the compiler cannot unroll it; do-while then spares the test before the first one.
uint turns(const uint count, uint n) { return STRAIGHT != 0u ? count : min(n, 1u) * count; }
