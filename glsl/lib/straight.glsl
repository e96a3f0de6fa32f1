// Whether a kernel's products are straight-line code, with no loop and no question around them. Mesa 22.3's software device asks each lane
// at every load inside of one; outside it loads a weight once for all lanes, and is ten times faster. Its successors make the better code
// of loops. Forms::of measures which; wide networks are loops in any case, since nobody compiles them straight.

// The turns of a loop with [[unroll]], of which there are `count`: the compiler either knows that, or cannot know it and leaves the loop
// alone. `n` is any number that is not 0. (Where it cannot know, `do` and `while` spare the question whether there is a first turn.)
uint turns(const uint count, uint n) { return STRAIGHT != 0u ? count : min(n, 1u) * count; }
