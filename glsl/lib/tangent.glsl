// What the kernels of the tangent-normal loss share (Rosu and Behnke 2023, PermutoSDF, as in NeuRodin's released code).
#include "lib/normal.glsl"

const float PI = 3.14159265359;
const float TANGENT_STEP = 0.01;  // region units; the cross product is not normalised again

// Uniform on the unit sphere: z and the angle about it are uniform.
vec3 random_direction(F32s draws, uint p, uint n) {
    float z = 2.0 * draws.at[p] - 1.0;
    float angle = 2.0 * PI * draws.at[n + p];
    float radius = sqrt(max(1.0 - z * z, 0.0));
    return vec3(radius * cos(angle), radius * sin(angle), z);
}
