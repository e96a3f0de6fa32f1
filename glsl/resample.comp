#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
// New bins where a proposal's weights are, one invocation per ray (Barron et al. 2022, Mip-NeRF 360):
//     tau_i = exp(raw_i) length_i,  w_i = (1 - e^-tau_i) exp(-sum_{j<i} tau_j)                     the proposal's weights, kept for its loss
//     h_i = w_i^anneal + 0.01,  c_i = sum_{j<i} h_j / sum_j h_j                                    a histogram that leaves no bin empty
//     u_j = (j + xi) / n_edges with xi = draw (training) or 1/2,  edge_j = c^-1(u_j)               linear inside a bin, right-sided at ties
// Edges carry no gradient.
layout(push_constant, scalar) uniform Args {
    F32s raw;          // [n_rays, n_samples] logarithm of density, the network's output
    F32s edges;        // [n_rays, n_samples + 1] in [0,1]
    F32s near_far;     // [2, n_rays]
    F32s jitter;       // [n_rays] in [0,1), one per ray; read only while training
    F32sMut weights;   // [n_rays, n_samples] of the proposal, not annealed
    F32sMut new_edges; // [n_rays, n_new + 1] in [0,1], never decreasing
    uint n_rays;
    uint n_samples;
    uint n_new;
    uint train;   // 0: no jitter
    float anneal; // exponent: 0 makes the histogram uniform, 1 takes the weights as they are
};

const float HISTOGRAM_PADDING = 0.01;

float histogram(float weight) {
    float annealed = anneal == 1.0 ? weight : anneal == 0.0 ? 1.0 : weight > 0.0 ? pow(weight, anneal) : 0.0;
    return annealed + HISTOGRAM_PADDING;
}

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint row = ray * n_samples;
    uint edge_row = ray * (n_samples + 1u);

    // Weights by quadrature, and the histogram's total.
    Span span = ray_span(near_far, n_rays, ray);
    float depth = 0.0, transmittance = 1.0, total = 0.0;
    float s0 = edges.at[edge_row];
    for (uint i = 0u; i < n_samples; i++) {
        float s1 = edges.at[edge_row + i + 1u];
        float tau = proposal_density(raw.at[row + i]) * bin_length(span, s0, s1);
        float weight = opacity(tau) * transmittance;
        weights.at[row + i] = weight;
        total += histogram(weight);
        depth += tau;
        transmittance = exp(-depth);
        s0 = s1;
    }

    // Walk the old bins and the new edges together: both only go forward. [c0, c1) is the share of the histogram in the old bin [lo, hi).
    uint bin = 0u;
    float sum = histogram(weights.at[row]);
    float c0 = 0.0, c1 = min(sum / total, 1.0);
    float lo = edges.at[edge_row], hi = edges.at[edge_row + 1u];
    float offset = train != 0u ? jitter.at[ray] : 0.5;
    float previous = 0.0;
    uint n_edges = n_new + 1u;
    for (uint j = 0u; j < n_edges; j++) {
        float u = (float(j) + offset) / float(n_edges);
        while (bin < n_samples && c1 <= u) {
            bin++;
            c0 = c1;
            lo = hi;
            if (bin < n_samples) {
                sum += histogram(weights.at[row + bin]);
                c1 = min(sum / total, 1.0);
                hi = edges.at[edge_row + bin + 1u];
            }
        }
        float s = bin < n_samples ? min(lo + clamp((u - c0) / (c1 - c0), 0.0, 1.0) * (hi - lo), hi) : lo;
        previous = max(previous, s); // rounding must not turn an edge back
        new_edges.at[ray * n_edges + j] = previous;
    }
}
