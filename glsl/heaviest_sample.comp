#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
// The heaviest sample of every ray and the two points behind it where bias correction asks the surface network (Wang et al. 2024, NeuRodin):
//     k = argmax_i w_i (the first of equals),  P = o + (t_k + t_{k+1})/2 d,  queries P + eps d and P + offset d
//     gate = [min_i sdf_i < 0] and, where need_opaque, [sum_i w_i > 0.999]; closed on rays outside the region
// Rays whose gate is closed have no loss of their own: unless ask_all they all ask at the origin, whose look-ups cost next to nothing.
// One subgroup per ray, its lanes share the samples; any subgroup size and any number of groups is right, rays are strided over.
layout(push_constant, scalar) uniform Args {
    F32s weights;       // [n_rays, n_samples]
    F32s sdf;           // [n] at bin starts
    F32s edges;         // [n_rays, n_samples + 1]
    F32s near_far;      // [2, n_rays]
    U32s ray_outside;   // [n_rays]
    F32s origins;       // [3, n_rays]
    F32s directions;    // [3, n_rays]
    F32sMut queries;    // [3, 2 n_rays]: P + eps d, then P + offset d, or the origin
    F32sMut gate;       // [n_rays] 0 or 1
    U32sMut heaviest;   // [n_rays] k
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    float eps;          // region units
    float offset;       // region units
    uint need_opaque;   // 1: with a background the ray must be opaque
    uint ask_all;       // 1: rays whose gate is closed ask, too
};

const float OPAQUE = 0.999;

void main() {
    uint n_groups = gl_NumWorkGroups.x * gl_NumWorkGroups.y;
    uint lane = gl_SubgroupInvocationID;
    for (uint ray = group() * gl_NumSubgroups + gl_SubgroupID; ray < n_rays; ray += n_groups * gl_NumSubgroups) {
        uint row = ray * n_samples;
        float best = -1.0, lowest = 1e30, sum = 0.0;
        uint best_index = n_samples - 1u;
        for (uint i = lane; i < n_samples; i += gl_SubgroupSize) {
            float weight = weights.at[row + i];
            if (weight > best) {
                best = weight;
                best_index = i;
            }
            lowest = min(lowest, sdf.at[row + i]);
            sum += weight;
        }
        float heaviest_weight = subgroupMax(best);
        uint k = subgroupMin(best == heaviest_weight ? best_index : n_samples - 1u);
        lowest = subgroupMin(lowest);
        sum = subgroupAdd(sum);

        if (subgroupElect()) {
            bool open = lowest < 0.0 && ray_outside.at[ray] == 0u && (need_opaque == 0u || sum > OPAQUE);
            gate.at[ray] = open ? 1.0 : 0.0;
            heaviest.at[ray] = k;
            uint edge = row + ray + k;
            float t = bin_midpoint(ray_span(near_far, n_rays, ray), edges.at[edge], edges.at[edge + 1u]);
            vec3 d = vector_at(directions, ray, n_rays);
            vec3 middle = vector_at(origins, ray, n_rays) + t * d;
            bool asks = open || ask_all != 0u;
            set_vector(queries, ray, 2u * n_rays, asks ? middle + eps * d : vec3(0.0));
            set_vector(queries, n_rays + ray, 2u * n_rays, asks ? middle + offset * d : vec3(0.0));
        }
    }
}
