// Density and opacity along a ray: from a signed distance and a local scale to what a volume lets through, with derivatives.

// 1 - exp(-tau) for tau >= 0, accurate relative to its own size: thin bins have tau far below the last digit of 1.
float opacity(float tau) {
    float series = tau * (1.0 - tau * (1.0 / 2.0) * (1.0 - tau * (1.0 / 3.0) * (1.0 - tau * (1.0 / 4.0)
        * (1.0 - tau * (1.0 / 5.0) * (1.0 - tau * (1.0 / 6.0) * (1.0 - tau * (1.0 / 7.0)))))));
    return tau < 0.35 ? series : 1.0 - exp(-tau);
}

// The inverse of the local Laplace scale beta, learned per sample (Wang et al. 2024, NeuRodin):
//     inv_s = max(1 / (scale_range sigmoid(logit) + scale_floor), inv_s_lower)
struct LocalScale {
    float inv_s;
    float d_logit; // d inv_s / d logit; zero where the lower bound acts
};

LocalScale local_scale(float logit, float scale_range, float scale_floor, float inv_s_lower) {
    float e = exp(-abs(logit));
    float sigmoid = (logit >= 0.0 ? 1.0 : e) / (1.0 + e);
    float inv_s = 1.0 / (scale_range * sigmoid + scale_floor);
    if (inv_s < inv_s_lower) return LocalScale(inv_s_lower, 0.0);
    return LocalScale(inv_s, -inv_s * inv_s * scale_range * e / ((1.0 + e) * (1.0 + e)));
}

// Density as the scaled Laplace distribution function of -sdf (Yariv et al. 2021, VolSDF, equations 2 and 3), amplitude 1/beta = inv_s:
//     sigma = inv_s/2 exp(-sdf inv_s)          for sdf >= 0 (free space)
//             inv_s (1 - exp(sdf inv_s)/2)     for sdf < 0  (inside matter)
struct Density {
    float sigma;
    float d_sdf;   // d sigma / d sdf
    float d_inv_s; // d sigma / d inv_s
};

Density laplace_density(float sdf, float inv_s) {
    float x = abs(sdf) * inv_s;
    float tail = 0.5 * exp(-x);
    float d_tail = tail * (1.0 - x);
    float d_sdf = -inv_s * inv_s * tail;
    return sdf >= 0.0 ? Density(inv_s * tail, d_sdf, d_tail) : Density(inv_s * (1.0 - tail), d_sdf, 1.0 - d_tail);
}

// The signed distance that stands for empty space on rays which do not meet the region.
const float EMPTY_SDF = 1000.0;

// Density of a proposal network, exp of its output. The bound only keeps sums of optical depth finite: e^80 is opaque at any bin length.
float proposal_density(float raw) {
    return exp(min(raw, 80.0));
}

// What its backward pass uses for d density / d raw (instant-ngp's truncated exponential): bounded on both sides.
float proposal_density_slope(float raw) {
    return exp(clamp(raw, -15.0, 15.0));
}

// The network's colour in (0,1) is stretched a little so that black and white can be reached (Barron et al. 2021, Mip-NeRF).
const float RGB_PADDING = 0.001;

float padded_rgb(float rgb) {
    return (1.0 + 2.0 * RGB_PADDING) * rgb - RGB_PADDING;
}
