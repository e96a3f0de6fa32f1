// What the kernels of the tangent-normal loss share (METHOD 4.5).

const float PI = 3.14159265359;
const float TANGENT_STEP = 0.01;  // region units; the cross product is not normalised again

vec3 vector_at(F32s planes, uint p, uint n) { return vec3(planes.at[p], planes.at[n + p], planes.at[2u * n + p]); }

vec3 normal_of(vec3 g) { return g / max(length(g), 1e-12); }

// What g hears from its normal: (d_n - n (n·d_n)) / ‖g‖.
vec3 normal_backward(vec3 g, vec3 d_n) {
    vec3 n = normal_of(g);
    return (d_n - n * dot(n, d_n)) / max(length(g), 1e-12);
}

// Uniform on the unit sphere: z and the angle about it are uniform.
vec3 random_direction(F32s draws, uint p, uint n) {
    float z = 2.0 * draws.at[p] - 1.0;
    float angle = 2.0 * PI * draws.at[n + p];
    float radius = sqrt(max(1.0 - z * z, 0.0));
    return vec3(radius * cos(angle), radius * sin(angle), z);
}
