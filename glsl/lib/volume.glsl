// Density and opacity along a ray: from a signed distance and a local scale to what a volume lets through, with derivatives.

// 1 - exp(-tau) for tau >= 0, accurate relative to its own size: thin bins have tau far below the last digit of 1.
float opacity(float tau) {
    float series = tau * (1.0 - tau * (1.0 / 2.0) * (1.0 - tau * (1.0 / 3.0) * (1.0 - tau * (1.0 / 4.0)
        * (1.0 - tau * (1.0 / 5.0) * (1.0 - tau * (1.0 / 6.0) * (1.0 - tau * (1.0 / 7.0)))))));
    return tau < 0.35 ? series : 1.0 - exp(-tau);
}

// Density of a proposal network, exp of its output. The bound only keeps sums of optical depth finite: e^80 is opaque at any bin length.
float proposal_density(float raw) {
    return exp(min(raw, 80.0));
}

// What its backward pass uses for d density / d raw (instant-ngp's truncated exponential): bounded on both sides.
float proposal_density_slope(float raw) {
    return exp(clamp(raw, -15.0, 15.0));
}

// Density of the background's field, exp of its output. e^15 is opaque at any bin length, and sums of optical depth stay finite over bins
// of hundreds of units.
float background_density(float raw) {
    return exp(min(raw, 15.0));
}

// d density / d raw: none where the bound acts.
float background_density_slope(float raw) {
    return raw > 15.0 ? 0.0 : exp(raw);
}

// The network's colour in (0,1) is stretched a little so that black and white can be reached (Barron et al. 2021, Mip-NeRF).
const float RGB_PADDING = 0.001;

vec3 padded_rgb(vec3 rgb) {
    return (1.0 + 2.0 * RGB_PADDING) * rgb - RGB_PADDING;
}
