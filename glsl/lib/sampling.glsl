// Where along a ray the samples lie: normalised positions s in [0,1], distances t, and what is between.
//
// A ray's positions are kept in a warped distance S (Barron et al. 2022, Mip-NeRF 360) that is linear up to t = 1 and linear in disparity
// beyond it:
//     S(t) = t/2          for t < 1        S^-1(u) = 2u          for u < 1/2
//            1 - 1/(2t)   for t >= 1                 1/(2 - 2u)  for u >= 1/2
//     t(s) = S^-1(s S(far) + (1 - s) S(near))
// Bin i of a ray lies between its edges s_i and s_{i+1}; edges of ray r start at r * (n_samples + 1).

float warped(float t) {
    return t < 1.0 ? 0.5 * t : 1.0 - 0.5 / t;
}

float unwarped(float u) {
    return u < 0.5 ? 2.0 * u : 0.5 / (1.0 - u);
}

// The part of the warped axis that a ray may use.
struct Span {
    float near;   // S(near)
    float extent; // S(far) - S(near)
};

// near_far is [2, n_rays]: the plane of near distances, then that of far distances.
Span ray_span(F32s near_far, uint n_rays, uint ray) {
    float near = warped(near_far.at[ray]);
    return Span(near, warped(near_far.at[n_rays + ray]) - near);
}

float distance_at(Span span, float s) {
    return unwarped(span.near + s * span.extent);
}

// t(s1) - t(s0), from the difference of the positions: subtracting two distances would leave only a few digits of a short bin.
float bin_length(Span span, float s0, float s1) {
    float u0 = span.near + s0 * span.extent;
    float u1 = span.near + s1 * span.extent;
    float du = (s1 - s0) * span.extent;
    if (u1 < 0.5) return 2.0 * du;
    if (u0 >= 0.5) return 0.5 * du / ((1.0 - u0) * (1.0 - u1));
    return (1.0 - 2.0 * u0) + (u1 - 0.5) / (1.0 - u1);
}

float bin_midpoint(Span span, float s0, float s1) {
    return 0.5 * (distance_at(span, s0) + distance_at(span, s1));
}
