#version 460
#include "lib/prelude.glsl"
// First bins of a ray: equal in the warped distance, moved together by one draw per ray while training. One invocation per edge.
//     s_j = j / n_samples,  c_j = (s_j + s_{j+1})/2,  edge_j = L_j + (U_j - L_j) u   with L = s_0, c_0, ..., U = c_0, ..., s_n
layout(push_constant, scalar) uniform Args {
    F32s jitter;   // [n_rays] in [0,1), one per ray; read only while training
    F32sMut edges; // [n_rays, n_samples + 1] in [0,1]
    uint n_rays;
    uint n_samples;
    uint train; // 0: no jitter
};

void main() {
    uint index = item();
    uint n_edges = n_samples + 1u;
    if (index >= n_rays * n_edges) return;
    uint ray = index / n_edges;
    uint edge = index % n_edges;
    float position = float(edge);
    if (train != 0u) {
        float lower = edge == 0u ? 0.0 : position - 0.5;
        float upper = edge == n_samples ? position : position + 0.5;
        position = lower + (upper - lower) * jitter.at[ray];
    }
    edges.at[index] = position / float(n_samples);
}
