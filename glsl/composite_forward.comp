#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
#include "lib/image.glsl"
// From optical depths and colours to the picture, one invocation per ray (Mildenhall et al. 2020, NeRF, equation 3):
//     T_i = exp(-sum_{j<i} tau_j),  w_i = (1 - e^-tau_i) T_i
//     color = sum_i w_i (1.002 rgb_i - 0.001) + T_end background,  accumulation = sum_i w_i = 1 - T_end
//     depth = sum_i w_i (t_i + t_{i+1})/2 / (sum_i w_i + 1e-10)
// T_end is the transmittance after the last sample.
layout(push_constant, scalar) uniform Args {
    F32s optical_depth; // [n] tau
    F32s edges;         // [n_rays, n_samples + 1]
    F32s near_far;      // [2, n_rays]
    F32s rgb;           // [3, n] in [0,1]
    F32s background;    // [3, n_rays]
    F32sMut weights;    // [n_rays, n_samples]
    F32sMut image;      // [6, n_rays] lib/image.glsl
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    Span span = ray_span(near_far, n_rays, ray);

    float tau_sum = 0.0, transmittance = 1.0, weighted_distance = 0.0;
    vec3 color = vec3(0.0);
    float s0 = edges.at[ray * (n_samples + 1u)];
    for (uint i = 0u; i < n_samples; i++) {
        uint p = ray * n_samples + i;
        float s1 = edges.at[p + ray + 1u];
        float tau = optical_depth.at[p];
        float weight = opacity(tau) * transmittance;
        weights.at[p] = weight;
        color += weight * padded_rgb(vector_at(rgb, p, n));
        weighted_distance += weight * bin_midpoint(span, s0, s1);
        tau_sum += tau;
        transmittance = exp(-tau_sum);
        s0 = s1;
    }

    float accumulation = opacity(tau_sum);
    set_vector(image, ray, n_rays, color + transmittance * vector_at(background, ray, n_rays));
    image.at[IMAGE_ACCUMULATION * n_rays + ray] = accumulation;
    image.at[IMAGE_TRANSMITTANCE * n_rays + ray] = transmittance;
    image.at[IMAGE_DEPTH * n_rays + ray] = weighted_distance / (accumulation + 1e-10);
}
