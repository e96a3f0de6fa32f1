#version 460
#include "lib/prelude.glsl"
#include "lib/rays.glsl"
// The rays of pixels first, first + 1, ... of one view, row by row, one per invocation: what rendering a picture needs.
// Indices past the last pixel repeat the last pixel.
layout(push_constant, scalar) uniform Args {
    Views views;
    F32sMut origins;     // [3, n_rays] region frame
    F32sMut directions;  // [3, n_rays] unit length
    F32sMut near_far;    // [2, n_rays]
    U32sMut ray_view;    // [n_rays] all set to appearance_view
    U32sMut ray_outside; // [n_rays] 1 where the ray misses the region
    uint n_rays;
    uint view;            // entry of views
    uint first;           // pixel
    uint appearance_view; // the training view whose appearance code colours these rays
    uint region_shape;    // 0: unit sphere, 1: box
    vec3 half_extents;    // of the box
};

void main() {
    uint index = item();
    if (index >= n_rays) return;
    View camera = views.at[view];
    uint number = min(first + index, camera.width * camera.height - 1u);
    uvec2 pixel = uvec2(number % camera.width, number / camera.width);
    Ray ray = pixel_ray(camera, pixel, region_shape, half_extents);
    set_vector(origins, index, n_rays, ray.origin);
    set_vector(directions, index, n_rays, ray.direction);
    near_far.at[index] = ray.near;
    near_far.at[n_rays + index] = ray.far;
    ray_view.at[index] = appearance_view;
    ray_outside.at[index] = ray.outside;
}
