#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
#include "lib/normal.glsl"
#include "lib/supervision.glsl"
// Adjoint of composite_forward's colour, one invocation per ray; every gradient is overwritten.
//     g_i = d_color . (1.002 rgb_i - 0.001),  g_end = d_color . background                  what one unit of weight is worth
//     D_i = g_i - g_{i+1} + e^-tau_{i+1} D_{i+1}, from g_n = g_end, D_n = 0                 and how much more than all that it hides
//     d_tau_i = T_{i+1} D_i,  d_rgb_i = 1.002 w_i d_color,  d_background = T_end d_color
// Where there are losses on more of a ray than its colour,
//     g_i also has d_depth ((t_i + t_{i+1})/2 - depth)/(sum_i w_i + 1e-10) + d_normal . n_i,  g_end has -d_accumulation
// since the accumulation is 1 - T_end: added to every g_i instead it would take the digits of their differences.
// The textbook's T_{i+1} g_i - sum_{j>i} w_j g_j - T_end g_end is the same number, but cancels where neighbours have nearly one colour.
layout(constant_id = 0) const uint SUPERVISED = 0; // 1: there are such losses

layout(push_constant, scalar) uniform Args {
    F32s optical_depth;      // [n] tau
    F32s rgb;                // [3, n] in [0,1]
    F32s background;         // [3, n_rays]
    F32s d_color;            // [3, n_rays]
    F32s edges;              // [n_rays, n_samples + 1], this and the next four with SUPERVISED
    F32s near_far;           // [2, n_rays]
    F32s image;              // [6, n_rays] of composite_forward
    F32s gradient;           // [3, n] of the signed distance
    F32s d_image;            // [5, n_rays] lib/supervision.glsl
    F32sMut d_optical_depth; // [n]
    F32sMut d_rgb;           // [3, n] with respect to the colour before padding
    F32sMut d_background;    // [3, n_rays]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    uint row = ray * n_samples;

    // Forward: the transmittance after each sample, left in d_optical_depth until the way back overwrites it.
    float tau_sum = 0.0, transmittance = 1.0;
    for (uint i = 0u; i < n_samples; i++) {
        tau_sum += optical_depth.at[row + i];
        transmittance = exp(-tau_sum);
        d_optical_depth.at[row + i] = transmittance;
    }

    vec3 d_pixel = vector_at(d_color, ray, n_rays);
    vec3 behind = vector_at(background, ray, n_rays);
    set_vector(d_background, ray, n_rays, transmittance * d_pixel);

    float d_accumulation = 0.0, d_depth = 0.0, depth = 0.0, s1 = 0.0;
    vec3 d_normal = vec3(0.0);
    Span span = Span(0.0, 0.0);
    if (SUPERVISED != 0u) {
        span = ray_span(near_far, n_rays, ray);
        s1 = edges.at[row + ray + n_samples];
        depth = image.at[IMAGE_DEPTH * n_rays + ray];
        d_accumulation = d_image.at[D_ACCUMULATION * n_rays + ray];
        d_depth = d_image.at[D_DEPTH * n_rays + ray] / (image.at[IMAGE_ACCUMULATION * n_rays + ray] + 1e-10);
        d_normal = vector_at(d_image, D_NORMAL * n_rays + ray, n_rays);
    }

    // Backward.
    float next_worth = dot(d_pixel, behind) - d_accumulation; // g_{i+1}
    float passed = 0.0, advantage = 0.0;     // e^-tau_{i+1}, D_{i+1}
    for (uint k = 0u; k < n_samples; k++) {
        uint i = n_samples - 1u - k;
        uint p = row + i;
        float tau = optical_depth.at[p];
        float weight = opacity(tau);
        if (i > 0u) weight *= d_optical_depth.at[p - 1u];

        float worth = dot(d_pixel, padded_rgb(vector_at(rgb, p, n)));
        set_vector(d_rgb, p, n, (1.0 + 2.0 * RGB_PADDING) * weight * d_pixel);
        if (SUPERVISED != 0u) {
            float s0 = edges.at[p + ray];
            worth += d_depth * (bin_midpoint(span, s0, s1) - depth);
            worth += dot(d_normal, normal_of(vector_at(gradient, p, n)));
            s1 = s0;
        }
        advantage = worth - next_worth + passed * advantage;
        d_optical_depth.at[p] *= advantage;
        next_worth = worth;
        passed = exp(-tau);
    }
}
