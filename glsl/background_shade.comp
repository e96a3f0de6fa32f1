#version 460
// Direction and appearance rows of the background's colour network, one sample per invocation: real spherical harmonics up to
// degree 3 (16 of them) in the standard basis, and the ray's appearance code (after nerfstudio's nerfacto, as in NeuRodin's released code).
#include "lib/prelude.glsl"
#include "lib/background.glsl"

layout(push_constant, scalar) uniform Args {
    F32s directions;   // [3, n_rays]
    U32s ray_view;     // [n_rays]
    F32s appearance;   // [views, APPEARANCE]
    F32sMut shading;   // [rows, n]
    uint n;
    uint n_rays;
};

void main() {
    uint p = item();
    if (p >= n) return;
    uint ray = p / (n / n_rays);
    vec3 d = vector_at(directions, ray, n_rays);
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    // √(1/4π), √(3/4π), √(15/4π), √(5/16π), √(15/16π), √(35/32π), √(105/4π), √(21/32π), √(7/16π), √(105/16π)
    float harmonics[16] = float[16](
        0.28209479177387814,
        -0.48860251190291987 * y, 0.48860251190291987 * z, -0.48860251190291987 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.94617469575755997 * zz - 0.31539156525251999,
        -1.0925484305920792 * x * z, 0.54627421529603959 * (xx - yy),
        0.59004358992664352 * y * (yy - 3.0 * xx), 2.8906114426405538 * x * y * z, 0.45704579946446572 * y * (1.0 - 5.0 * zz),
        0.3731763325901154 * z * (5.0 * zz - 3.0), 0.45704579946446572 * x * (1.0 - 5.0 * zz),
        1.4453057213202769 * z * (xx - yy), 0.59004358992664352 * x * (3.0 * yy - xx));
    [[unroll]] for (uint h = 0u; h < 16u; ++h) shading.at[(ROW_HARMONICS + h) * n + p] = harmonics[h];
    for (uint a = 0u; a < APPEARANCE; ++a)
        shading.at[(ROW_APPEARANCE + a) * n + p] = appearance.at[ray_view.at[ray] * APPEARANCE + a];
}
