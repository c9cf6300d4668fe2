// Normal equations of the light (thesis eq. 5.5-5.6), summed in fixed order: one partial sum a tile of samples.
// Provides gather_samples, pool_samples, accumulate_tiles.
#ifndef COEFFICIENTS
#error COEFFICIENTS must be defined: the number of spherical-harmonics coefficients
#endif
#include "groups.clh"

#define TILE 8
#define TILE_SAMPLES 64
#define COLUMNS (COEFFICIENTS + 3)

#define LABEL_STATIC 1

// Mean usable radiance around each sample and its weight: 0 unless the sample lies on static surface with enough open sky
// and away from edges, where normals and the picture's registration are at their worst.
// radiance [h][w] (w = 1 usable), labels [h][w], openness, flatness [rows][cols] -> observed [rows][cols] (rgb, weight).
kernel void gather_samples(const int cols, const int rows, const int stride, const int width, const int height,
                           global const float4 *radiance, global const uchar *labels, global const float *openness,
                           global const float *flatness, const float least_openness, const float least_flatness,
                           global float4 *observed) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int x = stride / 2 + col * stride;
    const int y = stride / 2 + row * stride;
    float4 sum = (float4)(0.0f);
    int usable = openness[row * cols + col] >= least_openness && flatness[row * cols + col] >= least_flatness;
    for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
            const int pixel = clamp(y + dy, 0, height - 1) * width + clamp(x + dx, 0, width - 1);
            const float4 here = radiance[pixel];
            usable = usable && here.w > 0.0f && labels[pixel] == LABEL_STATIC;
            sum += here;
        }
    }
    observed[row * cols + col] = usable ? (float4)(sum.xyz / 9.0f, 1.0f) : (float4)(0.0f);
}

// Two samples see the same light if they lie on one plane to within a voxel a few voxels away and face the same way.
static inline int same_surface(const float4 position, const float4 normal, const float4 other, const float4 other_normal,
                               const float voxel_m) {
    const float3 offset = other.xyz - position.xyz;
    return dot(normal.xyz, other_normal.xyz) > 0.9f && fabs(dot(offset, normal.xyz)) < voxel_m + 0.1f * length(offset);
}

// Each of 4 x 4 neighbours was traced along another direction set: their mean has a small part of one's quadrature error,
// which least squares would take for signal (errors in variables). One item a pool, around every second sample: the mean
// over those of 4 x 4 samples (from one before to two after) on that sample's surface; weight: their share.
// transfer, observed [rows][cols] -> pooled_transfer [pool_rows][pool_cols][COEFFICIENTS], pooled [pool_rows][pool_cols] (rgb, w).
kernel void pool_samples(const int pool_cols, const int pool_rows, const int cols, const int rows, const int stride,
                         const int width, global const float4 *positions, global const float4 *normals,
                         global const float *transfer, global const float4 *observed, const float voxel_m,
                         global float *pooled_transfer, global float4 *pooled) {
    const int pool_col = get_global_id(0);
    const int pool_row = get_global_id(1);
    if (pool_col >= pool_cols || pool_row >= pool_rows) return;
    const int col = 2 * pool_col, row = 2 * pool_row;
    const int first = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    float sum[COEFFICIENTS];
    for (int i = 0; i < COEFFICIENTS; i++) sum[i] = 0.0f;
    float4 seen = (float4)(0.0f);
    if (observed[row * cols + col].w > 0.0f) {
        for (int r = max(row - 1, 0); r <= min(row + 2, rows - 1); r++) {
            for (int c = max(col - 1, 0); c <= min(col + 2, cols - 1); c++) {
                const int pixel = first + ((r - row) * width + c - col) * stride;
                if (observed[r * cols + c].w <= 0.0f) continue;
                if (!same_surface(positions[first], normals[first], positions[pixel], normals[pixel], voxel_m)) continue;
                for (int i = 0; i < COEFFICIENTS; i++) sum[i] += transfer[(r * cols + c) * COEFFICIENTS + i];
                seen += observed[r * cols + c];
            }
        }
    }
    const float count = seen.w > 0.0f ? seen.w : 1.0f;
    const int pool = pool_row * pool_cols + pool_col;
    for (int i = 0; i < COEFFICIENTS; i++) pooled_transfer[pool * COEFFICIENTS + i] = sum[i] / count;
    pooled[pool] = (float4)(seen.xyz / count, seen.w / 16.0f);
}

static inline float sum_of(const float16 v) {
    const float8 a = v.lo + v.hi;
    const float4 b = a.lo + a.hi;
    return (b.x + b.z) + (b.y + b.w);
}

// One work-group of 64 items a tile of 8 x 8 samples. With row vectors s = (transfer, r, g, b) of a tile's samples, its
// partial sum is the upper triangle of sum w s^T s, row by row, then sum w and the number of samples with w > 0.
// transfer [rows][cols][COEFFICIENTS], observed [rows][cols] (rgb, w) -> partial [tiles][COLUMNS (COLUMNS + 1) / 2 + 2].
kernel void accumulate_tiles(const int cols, const int rows, const int tile_cols, global const float *transfer,
                             global const float4 *observed, global float *partial) {
    local float samples[COLUMNS + 1][TILE_SAMPLES];  // the last: weights
    const int item = get_local_id(0);
    const int tile = group_number();
    const int col = (tile % tile_cols) * TILE + item % TILE;
    const int row = (tile / tile_cols) * TILE + item / TILE;
    const int inside = col < cols && row < rows;
    const int sample = inside ? row * cols + col : 0;
    const float4 seen = inside ? observed[sample] : (float4)(0.0f);
    for (int i = 0; i < COEFFICIENTS; i++) samples[i][item] = seen.w > 0.0f ? transfer[sample * COEFFICIENTS + i] : 0.0f;
    samples[COEFFICIENTS][item] = seen.x;
    samples[COEFFICIENTS + 1][item] = seen.y;
    samples[COEFFICIENTS + 2][item] = seen.z;
    samples[COLUMNS][item] = seen.w;
    barrier(CLK_LOCAL_MEM_FENCE);

    const int entries = COLUMNS * (COLUMNS + 1) / 2;
    global float *out = partial + tile * (entries + 2);
    for (int entry = item; entry < entries; entry += TILE_SAMPLES) {
        int a = 0, b = entry;
        while (b >= COLUMNS - a) b -= COLUMNS - a++;
        float16 sum = (float16)(0.0f);
        for (int k = 0; k < TILE_SAMPLES / 16; k++) sum += vload16(k, samples[COLUMNS]) * vload16(k, samples[a]) * vload16(k, samples[a + b]);
        out[entry] = sum_of(sum);
    }
    if (item == 0) {
        float weight = 0.0f;
        float used = 0.0f;
        for (int k = 0; k < TILE_SAMPLES; k++) {
            weight += samples[COLUMNS][k];
            used += samples[COLUMNS][k] > 0.0f ? 1.0f : 0.0f;
        }
        out[entries] = weight;
        out[entries + 1] = used;
    }
}
