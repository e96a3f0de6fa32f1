// What a pixel saw: COLMAP's camera models 0 to 10, lens distortion undone by Newton's method.
//
// With w the undistorted image coordinates of a direction ((X, Y)/Z for perspective models, the angle to the axis along (X, Y) for
// fisheye models), s = |w|^2:
//   rho(s) = (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) / (1 + k5 s + k6 s^2 + k7 s^3)
//   x' = x rho + 2 p1 x y + p2 (s + 2 x^2) + b1 s
//   y' = y rho + 2 p2 x y + p1 (s + 2 y^2) + b2 s,      pixel = focal w' + centre.
// FOV has a closed form. src/scene/camera.rs is the same in float64, with the derivation and the parameters' order.

const uint CAMERA_SIMPLE_PINHOLE = 0u;
const uint CAMERA_PINHOLE = 1u;
const uint CAMERA_SIMPLE_RADIAL = 2u;
const uint CAMERA_RADIAL = 3u;
const uint CAMERA_OPENCV = 4u;
const uint CAMERA_OPENCV_FISHEYE = 5u;
const uint CAMERA_FULL_OPENCV = 6u;
const uint CAMERA_FOV = 7u;
const uint CAMERA_SIMPLE_RADIAL_FISHEYE = 8u;
const uint CAMERA_RADIAL_FISHEYE = 9u;
const uint CAMERA_THIN_PRISM_FISHEYE = 10u;

// One Newton step towards distort(w) = target, no longer than what keeps it from leaping over a fold of the distortion.
vec2 camera_newton_step(vec2 w, vec2 target, vec4 numerator, vec3 denominator, vec2 tangential, vec2 prism) {
    float x = w.x, y = w.y, s = dot(w, w);
    float top = 1.0 + s * (numerator.x + s * (numerator.y + s * (numerator.z + s * numerator.w)));
    float d_top = numerator.x + s * (2.0 * numerator.y + s * (3.0 * numerator.z + s * 4.0 * numerator.w));
    float bottom = 1.0 + s * (denominator.x + s * (denominator.y + s * denominator.z));
    float d_bottom = denominator.x + s * (2.0 * denominator.y + s * 3.0 * denominator.z);
    float rho = top / bottom;
    float d_rho = (d_top * bottom - top * d_bottom) / (bottom * bottom);
    float p1 = tangential.x, p2 = tangential.y;

    vec2 error = vec2(
        x * rho + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + prism.x * s,
        y * rho + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y) + prism.y * s) - target;
    float xx = rho + 2.0 * x * x * d_rho + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * prism.x * x;
    float xy = 2.0 * x * y * d_rho + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * prism.x * y;
    float yx = 2.0 * x * y * d_rho + 2.0 * p2 * y + 2.0 * p1 * x + 2.0 * prism.y * x;
    float yy = rho + 2.0 * y * y * d_rho + 2.0 * p2 * x + 6.0 * p1 * y + 2.0 * prism.y * y;
    float det = xx * yy - xy * yx;
    if (!(abs(det) > 1e-6 && abs(det) < 1e30)) return vec2(0.0);  // a fold, a pole, or not a number
    vec2 move = vec2(yy * error.x - xy * error.y, xx * error.y - yx * error.x) / det;
    return move * min(1.0, 0.5 * (1.0 + length(w)) / max(length(move), 1e-30));
}

// Direction in the OpenGL camera frame (x right, y up, looking along -z): z = -1 for perspective models, unit for fisheye models.
// pixel: (0.5, 0.5) is the centre of the first one. p: COLMAP's parameters, lengths in pixels.
vec3 camera_direction(uint model, float p[12], vec2 pixel) {
    bool single = model == CAMERA_SIMPLE_PINHOLE || model == CAMERA_SIMPLE_RADIAL || model == CAMERA_RADIAL
        || model == CAMERA_SIMPLE_RADIAL_FISHEYE || model == CAMERA_RADIAL_FISHEYE;
    bool fisheye = model == CAMERA_OPENCV_FISHEYE || model >= CAMERA_SIMPLE_RADIAL_FISHEYE;
    vec2 focal = single ? vec2(p[0]) : vec2(p[0], p[1]);
    vec2 centre = single ? vec2(p[1], p[2]) : vec2(p[2], p[3]);
    vec2 target = (pixel - centre) / focal;
    vec2 w = target;

    if (model == CAMERA_FOV) {
        float omega = p[4], radius = length(target);
        float angle = min(radius * abs(omega), 1.5707);
        if (abs(omega) > 1e-4 && angle > 1e-6) w = target * (tan(angle) / (2.0 * tan(0.5 * abs(omega)) * radius));
        else if (abs(omega) > 1e-4) w = target * (omega / (2.0 * tan(0.5 * omega)));
    } else if (model > CAMERA_PINHOLE) {
        vec4 numerator = vec4(0.0);
        vec3 denominator = vec3(0.0);
        vec2 tangential = vec2(0.0), prism = vec2(0.0);
        if (single) {
            numerator.x = p[3];
            if (model == CAMERA_RADIAL || model == CAMERA_RADIAL_FISHEYE) numerator.y = p[4];
        } else if (model == CAMERA_OPENCV_FISHEYE) {
            numerator = vec4(p[4], p[5], p[6], p[7]);
        } else {
            numerator.xy = vec2(p[4], p[5]);
            tangential = vec2(p[6], p[7]);
            if (model == CAMERA_FULL_OPENCV) {
                numerator.z = p[8];
                denominator = vec3(p[9], p[10], p[11]);
            } else if (model == CAMERA_THIN_PRISM_FISHEYE) {
                numerator.zw = vec2(p[8], p[9]);
                prism = vec2(p[10], p[11]);
            }
        }
        // Quadratic convergence: lenses that an image was taken with need 3 to 6 steps to float32's precision.
        for (int newton = 0; newton < 12; newton++)
            w -= camera_newton_step(w, target, numerator, denominator, tangential, prism);
    }

    if (!fisheye) return vec3(w.x, -w.y, -1.0);
    float theta = length(w);
    if (theta < 1e-6) return vec3(w.x, -w.y, -1.0);
    float angle = min(theta, 3.14159265);
    return vec3(w.x, -w.y, 0.0) * (sin(angle) / theta) + vec3(0.0, 0.0, -cos(angle));
}
