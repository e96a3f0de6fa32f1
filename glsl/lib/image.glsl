// Planes of what composite_forward makes of a ray, [6, n_rays]: red, green and blue, then these.

const uint IMAGE_ACCUMULATION = 3u;
const uint IMAGE_TRANSMITTANCE = 4u;  // behind the last sample
const uint IMAGE_DEPTH = 5u;          // distance along the ray, region units
