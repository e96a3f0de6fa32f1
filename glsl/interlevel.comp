#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
// A proposal level must cover the final weights (Barron et al. 2022, Mip-NeRF 360, equation 13), with the gradient down to its network's
// output; one invocation per ray. A final bin i touches the proposal bins lo..=hi:
//     lo = clip(#{j < P: edge_j <= s_i} - 1, 0, P - 1),  hi = clip(#{j < P: edge_{j+1} <= s_{i+1}}, 0, P - 1)
//     outer_i = sum_{m = lo..=hi} what_m,  loss_r = mean_i max(0, w_i - outer_i)^2 / (w_i + 1e-7)
// The loss is scale * sum_r loss_r. Final edges and weights carry no gradient. Backwards through the quadrature as in composite_backward:
//     D_m = d_what_m - d_what_{m+1} + e^-tau_{m+1} D_{m+1}, from d_what_P = D_P = 0,  d_tau_m = T_{m+1} D_m
// and through the truncated exponential: d_raw_m = d_tau_m length_m exp(clamp(raw_m, -15, 15)).
layout(push_constant, scalar) uniform Args {
    F32s final_edges;      // [n_rays, n_final + 1]
    F32s final_weights;    // [n_rays, n_final]
    F32s edges;            // [n_rays, n_samples + 1] of the proposal level
    F32s weights;          // [n_rays, n_samples] what, of the proposal level
    F32s raw;              // [n] the proposal network's output
    F32s near_far;         // [2, n_rays]
    F32sMut loss;          // [n_rays] before scale
    F32sMut d_raw;         // [n] after scale, overwritten
    F32sMut transmittance; // [n] scratch
    uint n_rays;
    uint n_final;
    uint n_samples; // n = n_rays n_samples
    float scale; // the loss's weight / number of rays
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint row = ray * n_samples, edge_row = row + ray;
    uint final_row = ray * n_final, final_edge_row = final_row + ray;
    Span span = ray_span(near_far, n_rays, ray);

    // Transmittance after every bin; d_raw starts as the gradient of the weights, zero.
    float tau_sum = 0.0;
    float s0 = edges.at[edge_row];
    for (uint m = 0u; m < n_samples; m++) {
        float s1 = edges.at[edge_row + m + 1u];
        tau_sum += proposal_density(raw.at[row + m]) * bin_length(span, s0, s1);
        transmittance.at[row + m] = exp(-tau_sum);
        d_raw.at[row + m] = 0.0;
        s0 = s1;
    }

    // Every final bin against the proposal bins it touches. Neighbours share at most a bin, so this is linear in both counts.
    float sum = 0.0;
    uint below = 0u, above = 0u;
    for (uint i = 0u; i < n_final; i++) {
        float start = final_edges.at[final_edge_row + i];
        float end = final_edges.at[final_edge_row + i + 1u];
        while (below < n_samples && edges.at[edge_row + below] <= start) below++;
        while (above < n_samples && edges.at[edge_row + above + 1u] <= end) above++;
        uint lo = max(below, 1u) - 1u;
        uint hi = min(above, n_samples - 1u);
        float outer = 0.0;
        for (uint m = lo; m <= hi; m++) outer += weights.at[row + m];
        float weight = final_weights.at[final_row + i];
        float excess = weight - outer;
        if (excess > 0.0) {
            sum += excess * excess / (weight + 1e-7);
            float d_outer = -2.0 * excess / (weight + 1e-7) * scale / float(n_final);
            for (uint m = lo; m <= hi; m++) d_raw.at[row + m] += d_outer;
        }
    }
    loss.at[ray] = sum / float(n_final);

    float next_worth = 0.0, passed = 0.0, advantage = 0.0; // d_what_{m+1}, e^-tau_{m+1}, D_{m+1}
    float s1 = s0;
    for (uint k = 0u; k < n_samples; k++) {
        uint m = n_samples - 1u - k;
        s0 = edges.at[edge_row + m];
        float bin = bin_length(span, s0, s1);
        float out_m = raw.at[row + m];
        float worth = d_raw.at[row + m];
        advantage = worth - next_worth + passed * advantage;
        d_raw.at[row + m] = transmittance.at[row + m] * advantage * bin * proposal_density_slope(out_m);
        next_worth = worth;
        passed = exp(-proposal_density(out_m) * bin);
        s1 = s0;
    }
}
