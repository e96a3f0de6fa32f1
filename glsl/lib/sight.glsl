// The angle at which a ray meets the level sets of the signed distance.

// g·d of sample p, kept from zero as published.
float cosine(F32s gradient, F32s directions, uint p, uint n, uint n_rays) {
    uint ray = p / (n / n_rays);
    float sum = 1e-8;
    [[unroll]] for (uint axis = 0u; axis < 3u; ++axis) sum += gradient.at[axis * n + p] * directions.at[axis * n_rays + ray];
    return sum;
}
