// What the losses on masks, depths and normals share: what is drawn with a pixel, and the gradient of its rendering.
#include "lib/image.glsl"

// Planes of what is drawn, [6, n_rays].
const uint PRIOR_COSINE = 0u;        // z-depth of a unit of distance along the ray
const uint PRIOR_MONO_DEPTH = 1u;    // z-depth up to scale and shift; not finite where unknown
const uint PRIOR_MONO_NORMAL = 2u;   // three, unit length, in the camera's axes (x right, y up, z backward); zero where unknown
const uint PRIOR_SENSOR_DEPTH = 5u;  // z-depth in region units; 0 where unknown

// Planes of d_image, the losses' gradient by what is rendered of a ray beside its colour, [5, n_rays].
const uint D_ACCUMULATION = 0u;
const uint D_DEPTH = 1u;   // by the distance along the ray
const uint D_NORMAL = 2u;  // three, region frame

// The weight of a ray in these losses: one that misses the region says nothing of the surface in it, nor does a masked-out one.
float ray_weight(F32s target, U32s ray_outside, uint ray, uint n_rays) {
    return ray_outside.at[ray] == 0u ? target.at[3u * n_rays + ray] : 0.0;
}
