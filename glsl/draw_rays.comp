#version 460
#include "lib/prelude.glsl"
#include "lib/rays.glsl"
// Training rays: one invocation turns three uniform numbers into a pixel drawn uniformly over all pictures, its ray and its colour.
//     view = first v with cumulative_share_v > u_0,  column = floor(u_1 width),  row = floor(u_2 height)
layout(push_constant, scalar) uniform Args {
    Views views;           // [n_views]
    F32s cumulative_share; // [n_views] pixels of views 0..=v over those of all views; the last is 1
    F32s pixel_draws;      // [3, n_rays] in [0,1): picture, column, row
    F32sMut origins;       // [3, n_rays] region frame
    F32sMut directions;    // [3, n_rays] unit length
    F32sMut near_far;      // [2, n_rays]
    U32sMut ray_view;      // [n_rays] index into views
    U32sMut ray_outside;   // [n_rays] 1 where the ray misses the region
    F32sMut target;        // [4, n_rays] red, green, blue in [0,1], and weight 0 or 1
    uint n_rays;
    uint n_views;
    uint use_mask;     // 0: every pixel counts
    uint region_shape; // 0: unit sphere, 1: box
    vec3 half_extents; // of the box
    uint one_view;     // 1: all rays are of the view that the first draw chooses
};

// Colour in [0,1] and weight of a pixel: 1, or 0 where masks are used and leave it out.
vec4 pixel_target(View view, uvec2 pixel) {
    vec4 rgba = unpackUnorm4x8(view.pixels.at[pixel.y * view.width + pixel.x]);
    return vec4(rgba.rgb, use_mask == 0u || rgba.a >= 0.5 ? 1.0 : 0.0);
}

void main() {
    uint index = item();
    if (index >= n_rays) return;
    float u = pixel_draws.at[one_view != 0u ? 0u : index];
    uint below = 0u, above = n_views - 1u;
    while (below < above) {
        uint middle = (below + above) / 2u;
        if (cumulative_share.at[middle] > u) above = middle;
        else below = middle + 1u;
    }
    View view = views.at[below];
    uvec2 pixel = drawn_pixel(view, pixel_draws, index, n_rays);
    Ray ray = pixel_ray(view, pixel, region_shape, half_extents);
    vec4 wanted = pixel_target(view, pixel);
    set_vector(origins, index, n_rays, ray.origin);
    set_vector(directions, index, n_rays, ray.direction);
    near_far.at[index] = ray.near;
    near_far.at[n_rays + index] = ray.far;
    ray_view.at[index] = below;
    ray_outside.at[index] = ray.outside;
    [[unroll]] for (uint channel = 0u; channel < 4u; channel++) target.at[channel * n_rays + index] = wanted[channel];
}
