#version 460
#define LOCAL_SIZE 256
#include "lib/prelude.glsl"
#include "lib/scalar.glsl"
#include "lib/supervision.glsl"
#include "lib/workgroup_sum.glsl"
// Squared error of the rendered z-depth against a monocular one that is known up to scale and shift, and its gradient; ONE workgroup, since
// a batch (of one view) has one scale and one shift (Yu et al. 2022, MonoSDF):
//     x = c t,  loss = (a x + b - p)^2 with a, b those of least squares over the batch:  a = cov(x, p)/var(x),  b = mean(p) - a mean(x)
// a and b are taken as constant. Since they minimise the very sum that is differentiated, its derivatives by them are zero: what is left
// is the whole gradient, not an approximation of it.
layout(push_constant, scalar) uniform Args {
    F32s image;       // [6, n_rays] of composite_forward
    F32s priors;      // [6, n_rays] of draw_priors
    F32s target;      // [4, n_rays]
    U32s ray_outside; // [n_rays]
    F32sMut loss;     // [n_rays] before scale
    F32sMut d_image;  // [5, n_rays] accumulated
    uint n_rays;
    float scale; // the loss's weight / number of rays
};

vec3 total(vec3 share) { return vec3(workgroup_sum(share.x), workgroup_sum(share.y), workgroup_sum(share.z)); }

// Rendered z-depth, prior and weight of a ray; the prior is 0 where the weight is.
vec3 pair(uint ray) {
    float p = priors.at[PRIOR_MONO_DEPTH * n_rays + ray];
    float weight = is_finite(p) ? ray_weight(target, ray_outside, ray, n_rays) : 0.0;
    return vec3(priors.at[PRIOR_COSINE * n_rays + ray] * image.at[IMAGE_DEPTH * n_rays + ray], weight > 0.0 ? p : 0.0, weight);
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    vec3 sum = vec3(0.0);
    for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) {
        vec3 xpw = pair(ray);
        sum += xpw.z * vec3(xpw.xy, 1.0);
    }
    sum = total(sum);
    vec2 mean = sum.xy / max(sum.z, 1.0);

    // Of differences from the means: the sums of squares themselves would cancel.
    sum = vec3(0.0);
    for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) {
        vec3 xpw = pair(ray);
        vec2 off = xpw.xy - mean;
        sum += xpw.z * vec3(off.x * off.x, off.x * off.y, 0.0);
    }
    sum = total(sum);
    float slope = sum.x > 0.0 ? sum.y / sum.x : 0.0; // one depth everywhere has no scale

    for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) {
        vec3 xpw = pair(ray);
        vec2 off = xpw.xy - mean;
        float error = slope * off.x - off.y;
        loss.at[ray] = xpw.z * error * error;
        d_image.at[D_DEPTH * n_rays + ray] += scale * xpw.z * 2.0 * error * slope * priors.at[PRIOR_COSINE * n_rays + ray];
    }
}
