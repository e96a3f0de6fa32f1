// Products of matrices by the device's cooperative matrices (VK_KHR_cooperative_matrix): C = A B, TILE_M × TILE_N of it per workgroup.
//
// Operands are float16, sums are float32. A chunk of A and of B is scaled by a power of two each, so that neither gradients vanish nor
// features overflow. COMPENSATED keeps what float16 drops as a second float16, and adds the products of each with the other's first: what
// is neglected is 2⁻²² of the chunk's largest number, and the product is float32's but for its last digits.
// The including kernel says what A and B are; what its own constants say comes first, so this is included after them.

// What the device multiplies: M × K by K × N. (Validation layers of 2025 look at the defaults alone: these are lavapipe's.)
layout(constant_id = 100) const uint MATRIX_M = 8;
layout(constant_id = 101) const uint MATRIX_N = 8;
layout(constant_id = 102) const uint MATRIX_K = 8;
layout(constant_id = 103) const uint SUBGROUP = 8;  // invocations of a subgroup
layout(constant_id = 104) const uint COMPENSATED = 1;

// Rows and columns of C per workgroup, and what of k is in shared memory at once; build.rs reads the three here.
layout(constant_id = 105) const uint TILE_M = 64;
layout(constant_id = 106) const uint TILE_N = 64;
layout(constant_id = 107) const uint TILE_K = 32;
const uint SUBGROUPS = LOCAL_SIZE / SUBGROUP;
const uint COLUMNS = TILE_N / MATRIX_N;
const uint ROWS = TILE_M / MATRIX_M;
const uint ROWS_EACH = (ROWS + SUBGROUPS - 1u) / SUBGROUPS;  // of a subgroup
// Rows of shared memory are a little longer than they need to be, so that neighbours lie in different banks.
const uint STRIDE_A = TILE_K + 8u;
const uint STRIDE_B = TILE_N + 8u;

// A number of the product's operands, 0 outside of them; asked in the order in which memory has them.
float a_at(uint m, uint k);
float b_at(uint k, uint n);

shared float16_t shared_a[2u * TILE_M * STRIDE_A];
shared float16_t shared_b[2u * TILE_K * STRIDE_B];
shared vec2 largest[SUBGROUPS];
shared float patches[SUBGROUPS * MATRIX_M * MATRIX_N];

#define Sums coopmat<float, gl_ScopeSubgroup, MATRIX_M, MATRIX_N, gl_MatrixUseAccumulator>
#define RowsOfA coopmat<float16_t, gl_ScopeSubgroup, MATRIX_M, MATRIX_K, gl_MatrixUseA>
#define ColumnsOfB coopmat<float16_t, gl_ScopeSubgroup, MATRIX_K, MATRIX_N, gl_MatrixUseB>

// Exponent, with its bias, of the power of two that takes a chunk's largest number to between 128 and 256. Infinities and NaN stay what
// they are.
uint scale_exponent(float most) { return uint(clamp(261 - int(floatBitsToUint(most) >> 23u), 1, 253)); }

float power_of_two(uint exponent) { return uintBitsToFloat(exponent << 23u); }

// A number as two float16s at `at` and `at + apart`. The first is cut off rather than rounded: drivers may take the way to float16 and
// back for no change.
#define SPLIT(to, at, apart, x) { \
    float high_ = COMPENSATED != 0u ? uintBitsToFloat(floatBitsToUint(x) & 0xffffe000u) : x; \
    to[at] = float16_t(high_); \
    to[(at) + (apart)] = float16_t((x) - high_); \
}

// Puts A[:, k0 .. k0 + TILE_K] and B[k0 .. k0 + TILE_K, :] into shared memory, scaled; what scales them back. All invocations take part.
vec2 load_chunk(uint k0) {
    const uint PART_A = TILE_M * TILE_K / LOCAL_SIZE, PART_B = TILE_K * TILE_N / LOCAL_SIZE;
    uint lane = gl_LocalInvocationID.x;
    float a[PART_A], b[PART_B];
    vec2 most = vec2(0.0);
    [[unroll]] for (uint j = 0u; j < PART_A; ++j) {
        uint e = lane + j * LOCAL_SIZE;
        a[j] = A_IS_COLUMN_MAJOR ? a_at(e % TILE_M, k0 + e / TILE_M) : a_at(e / TILE_K, k0 + e % TILE_K);
        most.x = max(most.x, abs(a[j]));
    }
    [[unroll]] for (uint j = 0u; j < PART_B; ++j) {
        uint e = lane + j * LOCAL_SIZE;
        b[j] = B_IS_COLUMN_MAJOR ? b_at(k0 + e % TILE_K, e / TILE_K) : b_at(k0 + e / TILE_N, e % TILE_N);
        most.y = max(most.y, abs(b[j]));
    }
    most = subgroupMax(most);
    if (subgroupElect()) largest[gl_SubgroupID] = most;
    barrier();
    [[unroll]] for (uint s = 0u; s < SUBGROUPS; ++s) most = max(most, largest[s]);
    uvec2 exponent = uvec2(scale_exponent(most.x), scale_exponent(most.y));
    [[unroll]] for (uint j = 0u; j < PART_A; ++j) {
        uint e = lane + j * LOCAL_SIZE;
        uint at = A_IS_COLUMN_MAJOR ? e % TILE_M * STRIDE_A + e / TILE_M : e / TILE_K * STRIDE_A + e % TILE_K;
        SPLIT(shared_a, at, TILE_M * STRIDE_A, a[j] * power_of_two(exponent.x))
    }
    [[unroll]] for (uint j = 0u; j < PART_B; ++j) {
        uint e = lane + j * LOCAL_SIZE;
        uint at = B_IS_COLUMN_MAJOR ? e % TILE_K * STRIDE_B + e / TILE_K : e / TILE_N * STRIDE_B + e % TILE_N;
        SPLIT(shared_b, at, TILE_K * STRIDE_B, b[j] * power_of_two(exponent.y))
    }
    barrier();
    return vec2(power_of_two(254u - exponent.x), power_of_two(254u - exponent.y));
}

// What becomes of a number of C; what it returns is summed up where the including kernel defines SUM_ROWS or SUM_COLUMNS.
float take(uint m, uint n, float value);

#ifdef SUM_ROWS
// The sum over n of what `take` returned.
void take_row(uint m, float sum);
#endif
#ifdef SUM_COLUMNS
// Of each column, what each subgroup has of its sum: cleared and read by the kernel.
shared float column_sums[SUBGROUPS * TILE_N];
#endif

// C = A B over k in begin .. end, number by number to `take`.
void multiply(uint begin, uint end) {
    Sums sums[ROWS_EACH * COLUMNS];
    [[unroll]] for (uint i = 0u; i < ROWS_EACH * COLUMNS; ++i) sums[i] = Sums(0.0);
    for (uint k0 = begin; k0 < end; k0 += TILE_K) {
        vec2 back = load_chunk(k0);
        [[unroll]] for (uint r = 0u; r < ROWS_EACH; ++r) {
            uint row = gl_SubgroupID + r * SUBGROUPS;
            if (row >= ROWS) continue;
            [[unroll]] for (uint c = 0u; c < COLUMNS; ++c) {
                Sums product = Sums(0.0);
                for (uint k = 0u; k < TILE_K; k += MATRIX_K) {
                    uint at_a = row * MATRIX_M * STRIDE_A + k, at_b = k * STRIDE_B + c * MATRIX_N;
                    RowsOfA a_high, a_low;
                    ColumnsOfB b_high, b_low;
                    coopMatLoad(a_high, shared_a, at_a, STRIDE_A, gl_CooperativeMatrixLayoutRowMajor);
                    coopMatLoad(b_high, shared_b, at_b, STRIDE_B, gl_CooperativeMatrixLayoutRowMajor);
                    if (COMPENSATED != 0u) {
                        coopMatLoad(a_low, shared_a, at_a + TILE_M * STRIDE_A, STRIDE_A, gl_CooperativeMatrixLayoutRowMajor);
                        coopMatLoad(b_low, shared_b, at_b + TILE_K * STRIDE_B, STRIDE_B, gl_CooperativeMatrixLayoutRowMajor);
                        product = coopMatMulAdd(a_low, b_high, product);
                        product = coopMatMulAdd(a_high, b_low, product);
                    }
                    product = coopMatMulAdd(a_high, b_high, product);
                }
                // Two factors, since their product may be too small for a number.
                sums[r * COLUMNS + c] += product * back.x * back.y;
            }
        }
    }
    // Subgroups without a row go along: barriers are for all of them.
    uint first = gl_SubgroupID * MATRIX_M * MATRIX_N, lane = gl_SubgroupInvocationID;
    [[unroll]] for (uint r = 0u; r < ROWS_EACH; ++r) {
        uint row = gl_SubgroupID + r * SUBGROUPS;
        uint end_element = row < ROWS ? MATRIX_M * MATRIX_N : 0u;
        float row_sum = 0.0;
        [[unroll]] for (uint c = 0u; c < COLUMNS; ++c) {
            coopMatStore(sums[r * COLUMNS + c], patches, first, MATRIX_N, gl_CooperativeMatrixLayoutRowMajor);
            subgroupBarrier();
            for (uint e = lane; e < end_element; e += SUBGROUP)
                patches[first + e] = take(row * MATRIX_M + e / MATRIX_N, c * MATRIX_N + e % MATRIX_N, patches[first + e]);
            subgroupBarrier();
#ifdef SUM_ROWS
            if (lane < MATRIX_M) {
                for (uint n = 0u; n < MATRIX_N; ++n) row_sum += patches[first + lane * MATRIX_N + n];
            }
            subgroupBarrier();
#endif
#ifdef SUM_COLUMNS
            if (lane < MATRIX_N && row < ROWS) {
                uint at = gl_SubgroupID * TILE_N + c * MATRIX_N + lane;
                for (uint m = 0u; m < MATRIX_M; ++m) column_sums[at] += patches[first + m * MATRIX_N + lane];
            }
            subgroupBarrier();
#endif
        }
#ifdef SUM_ROWS
        if (lane < MATRIX_M && row < ROWS) take_row(row * MATRIX_M + lane, row_sum);
#endif
    }
}
