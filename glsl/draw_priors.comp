#version 460
#include "lib/prelude.glsl"
#include "lib/rays.glsl"
#include "lib/supervision.glsl"
// What is known beforehand of the pixels that draw_rays drew, one invocation per ray: each prior at the nearest pixel of its own raster,
// and the z-depth of a unit of distance along the ray, d·forward.

layout(constant_id = 0) const uint MONO_DEPTH = 0;  // 1: every view has it
layout(constant_id = 1) const uint MONO_NORMAL = 0;
layout(constant_id = 2) const uint SENSOR_DEPTH = 0;

// One view's maps, each with a raster of its own.
struct ViewPriors {
    F32s mono_depth;   // [height, width]
    F32s mono_normal;  // [3, height, width]
    F32s sensor_depth; // [height, width] region units
    uint mono_depth_width;
    uint mono_depth_height;
    uint mono_normal_width;
    uint mono_normal_height;
    uint sensor_depth_width;
    uint sensor_depth_height;
};
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer ViewPriorTable { ViewPriors at[]; };

layout(push_constant, scalar) uniform Args {
    Views views;
    ViewPriorTable maps; // [training views]
    F32s pixel_draws;    // [3, n_rays] of draw_rays
    U32s ray_view;       // [n_rays]
    F32s directions;     // [3, n_rays]
    F32sMut priors;      // [6, n_rays] lib/supervision.glsl; planes of what no view has stay untouched
    uint n_rays;
};

// Where the middle of a picture's pixel falls on another raster of the same picture.
uint nearest(uvec2 pixel, View view, uint width, uint height) {
    uvec2 at = (2u * pixel + 1u) * uvec2(width, height) / (2u * uvec2(view.width, view.height));
    return at.y * width + at.x;
}

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    View view = views.at[ray_view.at[ray]];
    ViewPriors map = maps.at[ray_view.at[ray]];
    uvec2 pixel = drawn_pixel(view, pixel_draws, ray, n_rays);
    float m[12] = view.region_from_camera;
    priors.at[PRIOR_COSINE * n_rays + ray] = -dot(vec3(m[2], m[6], m[10]), vector_at(directions, ray, n_rays));
    if (MONO_DEPTH != 0u)
        priors.at[PRIOR_MONO_DEPTH * n_rays + ray] = map.mono_depth.at[nearest(pixel, view, map.mono_depth_width, map.mono_depth_height)];
    if (MONO_NORMAL != 0u) {
        uint at = nearest(pixel, view, map.mono_normal_width, map.mono_normal_height);
        uint size = map.mono_normal_width * map.mono_normal_height;
        set_vector(priors, PRIOR_MONO_NORMAL * n_rays + ray, n_rays, vector_at(map.mono_normal, at, size));
    }
    if (SENSOR_DEPTH != 0u)
        priors.at[PRIOR_SENSOR_DEPTH * n_rays + ray] = map.sensor_depth.at[nearest(pixel, view, map.sensor_depth_width, map.sensor_depth_height)];
}
