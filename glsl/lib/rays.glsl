// From a pixel of a view to a ray in the region's frame, its near and far distance.
#include "lib/camera.glsl"

// One picture and its camera. The region's frame is the world's, shifted and scaled so that the region is the unit sphere or a box in it.
struct View {
    U32s pixels;                 // RGBA8, row by row, red in the lowest byte; alpha is the mask
    float region_from_camera[12]; // 3 rows of 4: rotation and translation (in region units); the camera looks along -z, y up
    float params[12];            // of the camera model, in COLMAP's order
    uint model;                  // COLMAP's number of the camera model
    uint width;
    uint height;
    uint padding;                // keeps entries a multiple of 8 bytes
};
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer Views { View at[]; };

struct Ray {
    vec3 origin;
    vec3 direction; // unit length
    float near;
    float far;
    uint outside; // 1 where the ray does not meet the region
};

const uint REGION_SPHERE = 0u; // radius 1
const uint REGION_BOX = 1u;    // |x_j| <= half_extents_j

// Where a ray is inside the region: near = max(0, entry), far = exit. A ray that meets the region nowhere in front of the camera is
// flagged and gets the segment [1, 1.2], so that every number computed from it stays finite.
//   sphere: |o + t d| = 1 with b = o.d, q = 1 - |o - b d|^2:  t = -b -+ sqrt(q)
//   box: the slabs of Kay and Kajiya 1986
void meet_region(inout Ray ray, uint region_shape, vec3 half_extents) {
    float entry, exit;
    bool meets;
    if (region_shape == REGION_SPHERE) {
        float b = dot(ray.origin, ray.direction);
        vec3 closest = ray.origin - b * ray.direction; // q from here, not from b^2 - |o|^2 + 1, whose terms cancel for far cameras
        float q = 1.0 - dot(closest, closest);
        meets = q >= 0.0;
        float half_chord = sqrt(max(q, 0.0));
        entry = -b - half_chord;
        exit = -b + half_chord;
    } else {
        bvec3 parallel = lessThan(abs(ray.direction), vec3(1e-9));
        vec3 direction = mix(ray.direction, vec3(1e-9), parallel);
        vec3 a = (-half_extents - ray.origin) / direction;
        vec3 b = (half_extents - ray.origin) / direction;
        vec3 first = min(a, b), last = max(a, b);
        entry = max(max(first.x, first.y), first.z);
        exit = min(min(last.x, last.y), last.z);
        meets = exit >= entry;
    }
    entry = max(entry, 0.0);
    meets = meets && exit - entry > 1e-6;
    ray.near = meets ? entry : 1.0;
    ray.far = meets ? exit : 1.2;
    ray.outside = meets ? 0u : 1u;
}

// The ray through the centre of a pixel (column, row).
Ray pixel_ray(View view, uvec2 pixel, uint region_shape, vec3 half_extents) {
    vec3 d = camera_direction(view.model, view.params, vec2(pixel) + 0.5);
    float m[12] = view.region_from_camera;
    Ray ray;
    ray.origin = vec3(m[3], m[7], m[11]);
    ray.direction = normalize(vec3(
        m[0] * d.x + m[1] * d.y + m[2] * d.z,
        m[4] * d.x + m[5] * d.y + m[6] * d.z,
        m[8] * d.x + m[9] * d.y + m[10] * d.z));
    meet_region(ray, region_shape, half_extents);
    return ray;
}

// The pixel of a view that ray `index` of `n_rays` was drawn at: column = floor(u_1 width), row = floor(u_2 height).
uvec2 drawn_pixel(View view, F32s pixel_draws, uint index, uint n_rays) {
    uvec2 size = uvec2(view.width, view.height);
    uvec2 pixel = uvec2(vec2(pixel_draws.at[n_rays + index], pixel_draws.at[2u * n_rays + index]) * vec2(size));
    return min(pixel, size - 1u); // the product may round up to the size
}
