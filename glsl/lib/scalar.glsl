// Functions of one number that GLSL does not have.

// 1 / (1 + e^-x), accurate relative to its own size at both ends and without overflow.
float sigmoid(float x) {
    float e = exp(-abs(x));
    return (x >= 0.0 ? 1.0 : e) / (1.0 + e);
}

// By its bits: drivers may take it that there are neither infinities nor NaN, and answer isinf and isnan without looking.
bool is_finite(float x) { return (floatBitsToUint(x) & 0x7F800000u) != 0x7F800000u; }
