// Where the points lie around a sample from whose signed distances its gradient is had, and what is made of them. With unit vectors d_j,
// whose Σ d_j d_jᵀ = TAPS/3 I, and f_j = f(x + δ d_j):
//     g = 3/(TAPS δ) Σ d_j f_j,   trace of the Hessian = 6/(TAPS δ²) Σ (f_j − f(x))
// Six taps lie along the axes, both ways (as in NeuRodin's released code); four at the corners of a tetrahedron (as in Neuralangelo's).

layout(constant_id = 2) const uint TAPS = 6;  // 6 or 4; 0: the gradient is had otherwise
const uint BLOCKS = 1u + TAPS;                // of points: samples, then their taps

vec3 tap_direction(uint tap) {
    if (TAPS == 4u) {
        vec3 corner = tap == 0u ? vec3(1, -1, -1) : tap == 1u ? vec3(-1, -1, 1) : tap == 2u ? vec3(-1, 1, -1) : vec3(1, 1, 1);
        return 0.57735026919 * corner;
    }
    float side = (tap & 1u) == 0u ? 1.0 : -1.0;
    return vec3(tap / 2u == 0u ? side : 0.0, tap / 2u == 1u ? side : 0.0, tap / 2u == 2u ? side : 0.0);
}

// What stands before the two sums.
float gradient_factor(float delta) { return 3.0 / (float(TAPS) * delta); }

float trace_factor(float delta) { return 6.0 / (float(TAPS) * delta * delta); }

// How far they lie from their sample: U(0, range), not below the floor (Wang et al. 2024, NeuRodin).
float tap_step(float u, float range, float floor_) {
    return max(range * u, floor_);
}
