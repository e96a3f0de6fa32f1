// Normals of the signed distance, n = g/‖g‖, and their adjoint.

vec3 normal_of(vec3 g) { return g / max(length(g), 1e-12); }

// d_g = (d_n - n (n·d_n)) / ‖g‖.
vec3 normal_backward(vec3 g, vec3 d_n) {
    vec3 n = normal_of(g);
    return (d_n - n * dot(n, d_n)) / max(length(g), 1e-12);
}
