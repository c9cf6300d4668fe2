// Diffuse shadowed radiance transfer by ray tracing the volume (thesis 5.1.2, eq. 5.2), projected to spherical harmonics.
// Provides transfer_radiance.
#include "direction_sets.clh"
#include "sh.clh"
#include "visibility.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif

// What of the window around a sample lies on its own smooth surface: off its plane by less than a voxel a pixel of distance
// would explain, and with a normal within 25 degrees.
#define SAME_SURFACE 0.9f

// Mean normal (xyz, unit) over the pixels within `radius` of (x, y) on the same smooth surface, and their share (w).
// Reconstructed normals are noisy from voxel to voxel; a sample stands for its whole neighbourhood.
static float4 smooth_normal(const int width, const int height, global const float4 *positions, global const float4 *normals,
                            const int x, const int y, const int radius, const float voxel_m) {
    const int center = y * width + x;
    const float3 position = positions[center].xyz;
    const float3 normal = normals[center].xyz;
    float3 sum = (float3)(0.0f);
    int same = 0;
    for (int v = max(y - radius, 0); v <= min(y + radius, height - 1); v++) {
        for (int u = max(x - radius, 0); u <= min(x + radius, width - 1); u++) {
            const float4 n = normals[v * width + u];
            const float4 p = positions[v * width + u];
            const float3 offset = p.xyz - position;
            const float off_plane = fabs(dot(offset, normal));
            if (n.w > 0.0f && p.w > 0.0f && dot(n.xyz, normal) > SAME_SURFACE && off_plane < voxel_m + 0.3f * length(offset)) {
                sum += n.xyz;
                same++;
            }
        }
    }
    const int side = 2 * radius + 1;
    return (float4)(normalize(sum), (float)same / (side * side));
}

// T(x) = 1/pi * integral of V max(n.w, 0) Y(w) dw. The unoccluded part is exact (A_l Y(n) / pi); only what is blocked is
// sampled and taken away, so an open surface shades without quadrature error.
//
// One item a sample; samples lie every `stride` pixels from stride / 2. positions, normals [h][w]: the geometry buffer.
// directions [64][count]: unit directions and their solid angle (w, sr), basis [64][count][COEFFICIENTS]: Y there; see
// direction_sets.clh. radius: of the window that a sample's normal is the mean of, pixels.
// -> transfer [rows][cols][COEFFICIENTS], openness [rows][cols]: free share of the cosine-weighted
// sky (-1 where there is no surface), flatness [rows][cols]: share of the window on the sample's own surface, free_mask [rows][cols][MASK_WORDS]: bit j = direction j lies above the surface and is free.
kernel void transfer_radiance(const int cols, const int rows, const int stride, const int width, const int height, const int radius,
                              global const float4 *positions, global const float4 *normals,
                              const int4 bricks, global const int *slots, global const uchar *gaps,
                              global const ulong *solid, global const uchar *octets, global const float2 *voxels, const float voxel_m, const float truncation_m,
                              const int count, global const float4 *directions, global const float *basis,
                              const float reach_m,
                              global float *transfer, global float *openness, global float *flatness,
                              global uint *free_mask) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int sample = row * cols + col;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 position = positions[pixel];
    const int valid = position.w > 0.0f && normals[pixel].w > 0.0f;
    const float4 normal = valid ? smooth_normal(width, height, positions, normals, pixel % width, pixel / width, radius, voxel_m)
                                : (float4)(0.0f);
    const Volume volume = make_volume(bricks, voxel_m, truncation_m, slots, gaps, solid, octets, voxels);
    const float3 origin = position.xyz + voxel_m * normal.xyz;  // fig. 7.5

    float t[COEFFICIENTS];
    for (int i = 0; i < COEFFICIENTS; i++) t[i] = 0.0f;
    uint mask[MASK_WORDS];
    for (int i = 0; i < MASK_WORDS; i++) mask[i] = 0;
    float sky = 0.0f;
    float blocked_sky = 0.0f;
    if (valid) {
        sh_basis(normal.xyz, t);
        for (int l = 0; l < BANDS; l++)
            for (int i = l * l; i < (l + 1) * (l + 1); i++) t[i] *= lambert_band(l);
        const int set = direction_set(row, col) * count;
        int chosen[LANES];  // directions above the horizon, until there are enough to trace
        int waiting = 0;
        for (int j = 0; j < count; j++) {
            if (dot(normal.xyz, directions[set + j].xyz) > 0.0f) chosen[waiting++] = set + j;
            if (waiting < LANES && (j < count - 1 || waiting == 0)) continue;
            for (int lane = waiting; lane < LANES; lane++) chosen[lane] = chosen[0];
            const int open = bits_of(trace_volume(volume, volume_rays(volume, origin, directions, chosen), reach_m));
            for (int lane = 0; lane < waiting; lane++) {
                const float4 direction = directions[chosen[lane]];
                const float share = dot(normal.xyz, direction.xyz) * direction.w * M_1_PI_F;
                sky += share;
                if ((open >> lane) & 1) {
                    const int bit = chosen[lane] - set;
                    mask[bit >> 5] |= 1u << (bit & 31);
                } else {
                    blocked_sky += share;
                    global const float *y = basis + chosen[lane] * COEFFICIENTS;
                    for (int i = 0; i < COEFFICIENTS; i++) t[i] -= share * y[i];
                }
            }
            waiting = 0;
        }
    }
    for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = t[i];
    for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = mask[i];
    flatness[sample] = normal.w;
    openness[sample] = valid && sky > 0.0f ? 1.0f - blocked_sky / sky : -1.0f;
}
