// From a signed distance to the optical depth of a bin: the scale, and the densities of the methods, with derivatives.
#include "lib/scalar.glsl"

layout(constant_id = 0) const uint DENSITY = 0;
const uint DENSITY_LAPLACE = 0u;  // of the signed distance
const uint DENSITY_SIGHT = 1u;    // of the signed distance along the line of sight
const uint DENSITY_NEUS = 2u;     // none: an opacity of the distances at both ends of the bin

layout(constant_id = 1) const uint SCALE = 0;
const uint SCALE_LOCAL = 0u;        // one logit per sample (Wang et al. 2024, NeuRodin)
const uint SCALE_BETA = 1u;         // one beta for all (Yariv et al. 2021, VolSDF)
const uint SCALE_EXPONENTIAL = 2u;  // one exponent for all (Wang et al. 2021, NeuS)

struct Scale {
    float inv_s;        // 1/beta; NeuS calls it s
    float d_parameter;  // its derivative by what was learned
};

//     local        inv_s = max(1 / (range sigmoid(v) + floor), lower), with no derivative where the bound acts
//     beta         inv_s = 1 / (|v| + floor)
//     exponential  inv_s = e^(range v), kept within six decades of 1
Scale scale_of(float v, float range, float floor_, float lower) {
    if (SCALE == SCALE_EXPONENTIAL) {
        float s = exp(range * v);
        float kept = clamp(s, 1e-6, 1e6);
        return Scale(kept, s == kept ? range * s : 0.0);
    }
    if (SCALE == SCALE_BETA) {
        float inv_s = 1.0 / (abs(v) + floor_);
        return Scale(inv_s, -inv_s * inv_s * sign(v));
    }
    float inv_s = 1.0 / (range * sigmoid(v) + floor_);
    if (inv_s < lower) return Scale(lower, 0.0);
    return Scale(inv_s, -inv_s * inv_s * range * sigmoid(v) * sigmoid(-v));
}

struct BinDepth {
    float tau;
    float d_sdf;
    float d_cosine;  // by c = g·d
    float d_inv_s;
};

// Density as the scaled Laplace distribution function of -a (Yariv et al. 2021, VolSDF, equations 2 and 3), amplitude 1/beta = inv_s:
//     sigma = inv_s/2 exp(-a inv_s)          for a >= 0 (free space)
//             inv_s (1 - exp(a inv_s)/2)     for a < 0  (inside matter),   tau = sigma length
BinDepth laplace_depth(float a, float inv_s, float bin) {
    float x = abs(a) * inv_s;
    float tail = 0.5 * exp(-x);
    float d_tail = tail * (1.0 - x);
    float d_a = -inv_s * inv_s * tail;
    return a >= 0.0 ? BinDepth(bin * inv_s * tail, bin * d_a, 0.0, bin * d_tail)
                    : BinDepth(bin * inv_s * (1.0 - tail), bin * d_a, 0.0, bin * (1.0 - d_tail));
}

// The same of a = f/|c| (Zhang et al. 2023, TUVR): then the heaviest point lies equally far behind a plane whatever the angle.
BinDepth sight_depth(float f, float c, float inv_s, float bin) {
    BinDepth depth = laplace_depth(f / abs(c), inv_s, bin);
    depth.d_cosine = -depth.d_sdf * f / (c * abs(c));
    depth.d_sdf /= abs(c);
    return depth;
}

const float NEUS_EPSILON = 1e-5;

// NeuS's opacity alpha = (P - Q) / (P + eps) with P, Q = sigmoid(s (f ± h)) at the bin's ends, h = facing length / 2, as the optical depth
// -ln(1 - alpha) = ln((P + eps)/(Q + eps)). facing is -c where the ray enters; early in training the softer 1/2 - c/2 (anneal from 0 to 1).
BinDepth neus_depth(float f, float c, float s, float bin, float anneal) {
    float facing = mix(max(0.5 - 0.5 * c, 0.0), max(-c, 0.0), anneal);
    float d_facing = -mix(c < 1.0 ? 0.5 : 0.0, c < 0.0 ? 1.0 : 0.0, anneal);
    float half_step = 0.5 * facing * bin;
    float p = sigmoid(s * (f + half_step)), q = sigmoid(s * (f - half_step));
    float not_p = sigmoid(-s * (f + half_step)), not_q = sigmoid(-s * (f - half_step));
    float lost = p * not_q * opacity(2.0 * s * half_step);  // P - Q, which as a difference would cancel
    float alpha = lost / (p + NEUS_EPSILON);
    // d ln(P + eps) / d (s f) is P (1 - P)/(P + eps); difference and sum of both ends'.
    float difference = lost * (NEUS_EPSILON * (1.0 + NEUS_EPSILON) / ((p + NEUS_EPSILON) * (q + NEUS_EPSILON)) - 1.0);
    float sum = p * not_p / (p + NEUS_EPSILON) + q * not_q / (q + NEUS_EPSILON);
    BinDepth depth;
    depth.tau = alpha < 0.05 ? alpha * (1.0 + alpha * (1.0 / 2.0 + alpha * (1.0 / 3.0 + alpha * (1.0 / 4.0 + alpha * (1.0 / 5.0)))))
                             : log((p + NEUS_EPSILON) / (q + NEUS_EPSILON));
    depth.d_sdf = s * difference;
    depth.d_cosine = 0.5 * bin * s * sum * d_facing;
    depth.d_inv_s = f * difference + half_step * sum;
    return depth;
}

BinDepth bin_depth(float f, float c, float inv_s, float bin, float anneal) {
    if (DENSITY == DENSITY_NEUS) return neus_depth(f, c, inv_s, bin, anneal);
    if (DENSITY == DENSITY_SIGHT) return sight_depth(f, c, inv_s, bin);
    return laplace_depth(f, inv_s, bin);
}

// c = g·d of sample p, kept from zero as published: by what is added last, since a sum that began with it would lose it, and 0 comes out of
// one sample in some ten million. A derivative by 0 would make every parameter NaN, although the loss is finite.
float cosine(F32s gradient, F32s directions, uint p, uint n, uint ray, uint n_rays) {
    float c = dot(vector_at(gradient, p, n), vector_at(directions, ray, n_rays)) + 1e-8;
    return c == 0.0 ? 1e-8 : c;
}
