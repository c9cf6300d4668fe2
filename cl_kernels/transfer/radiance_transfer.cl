// Diffuse shadowed radiance transfer by ray tracing the volume (thesis 5.1.2, eq. 5.2), projected to spherical harmonics.
// Provides transfer_radiance.
#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif
#include "direction_sets.clh"
#include "hemisphere.clh"
#include "samples.clh"
#include "sh.clh"
#include "smooth_normal.clh"
#include "visibility_cache.clh"
#ifdef HAS_STATE
#include "visibility_state.clh"
#endif

#define LABEL_STATIC 1

// T(x) = 1/pi * integral of V max(n.w, 0) Y(w) dw. The unoccluded part is exact (A_l Y(n) / pi); only the blocked part
// is sampled and subtracted, so an open surface has no quadrature error.
//
// One item a sample. positions, normals, labels [h][w]: the geometry buffer. directions [sets][count]: unit directions and their solid
// angle (w, sr), basis [sets][count][COEFFICIENTS]: Y there;
// first_set: see direction_sets.clh. radius: of the window of a sample's mean normal, pixels.
// phase: the subset that this frame traces (visibility_cache.clh); intrinsics, layers, newest, cameras, points and behind them normals,
// traced, blocked: layers of earlier frames; this frame's layer (newest + 1) is written. state: see visibility_state.clh.
// -> transfer [rows][cols][COEFFICIENTS], openness [rows][cols]: free fraction of the cosine-weighted sky (-1 where there is no
// surface), flatness [rows][cols]: fraction of the window on the sample's own surface, free_mask [rows][cols][MASK_WORDS]: bit j =
// direction j lies above the surface and is free, sets [rows][cols][INTERLEAVE]: direction j is that of set sets[j % INTERLEAVE].
// With IS_CHOSEN only the samples `chosen` [chosen_count] are computed, one item each; the others keep their values. With HAS_CACHE
// those that are `found` (transfer_cache.cl) keep theirs; -> mean_normals [rows][cols]: of the others, w = flatness.
kernel void transfer_radiance(const TransferParameters parameters, global const float4 *positions, global const float4 *normals,
                              global const uchar *labels, global const int *slots, global const ulong *solid, global const uchar *octets,
                              global const float4 *directions, global const float *basis, global const float16 *cameras,
                              global float4 *points, global ushort *traced, global uint *blocked,
                              global float *transfer, global float *openness, global float *flatness,
                              global uint *free_mask, global uchar *sets
#ifdef HAS_STATE
                              , global const uint *state
#endif
#ifdef IS_CHOSEN
                              , global const int *chosen
#endif
#ifdef HAS_CACHE
                              , global const int *found, global float4 *mean_normals
#endif
) {
    const Grid grid = parameters.grid;
#ifdef IS_CHOSEN
    if ((int)get_global_id(0) >= parameters.chosen_count) return;
    const int sample = chosen[get_global_id(0)];
    const int col = sample % grid.cols;
    const int row = sample / grid.cols;
#else
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col;
#endif
#ifdef HAS_CACHE
    if (found[sample] >= 0) return;
#endif
    const int pixel = sample_pixel(grid, row, col), width = grid.width, count = parameters.count;
    const Volume volume = make_volume(parameters.volume, slots, solid, octets, 0);
    const float4 position = positions[pixel];
    const int valid = position.w > 0.0f && normals[pixel].w > 0.0f;
    const float4 normal = valid ? smooth_normal(width, parameters.height, positions, normals, pixel % width, pixel / width,
    parameters.radius, volume.voxel_m)
                                : (float4)(0.0f);
    const int own = parameters.first_set + direction_set(row, col);

    uint wanted = valid ? ALL_SUBSETS : 0u;
    uint stops[MASK_WORDS];  // directions that are blocked
    uchar set[INTERLEAVE];
    for (int i = 0; i < MASK_WORDS; i++) stops[i] = 0;
    for (int i = 0; i < INTERLEAVE; i++) set[i] = (uchar)own;
#ifdef HAS_STATE
    if (valid && is_open(volume, state, position.xyz)) wanted = 0;
#endif
#if INTERLEAVE > 1
    global float4 *cached_normals = (global float4 *)((global uchar *)points + parameters.cached_normals_at);
    const int lasting = valid && labels[pixel] == LABEL_STATIC;
    if (lasting && wanted) {
        const Layers known = {grid.cols, grid.rows, grid.stride, parameters.intrinsics, parameters.layers, parameters.newest, cameras,
        points, cached_normals, traced, blocked};
        wanted = find_cached(known, position.xyz, normal.xyz, volume.voxel_m, ALL_SUBSETS & ~(1u << parameters.phase), stops,
        set) | 1u << parameters.phase;
    }
#endif
    if (wanted) {
        uint asked[MASK_WORDS], open[MASK_WORDS];
        for (int i = 0; i < MASK_WORDS; i++) {
            asked[i] = bits_of_subsets(wanted);
            open[i] = 0;
        }
        trace_hemisphere(volume, position.xyz + volume.voxel_m * normal.xyz, normal.xyz, directions + own * count, count,
        parameters.ray_length_m, asked,
                         open, stops);  // fig. 7.5
    }
#if INTERLEAVE > 1
    const int layer = (parameters.newest + 1) % INTERLEAVE * grid.rows * grid.cols + sample;
    points[layer] = (float4)(position.xyz, lasting ? 1.0f : 0.0f);
    cached_normals[layer] = normal;
    traced[layer] = (ushort)(wanted | own << 8);
    for (int i = 0; i < MASK_WORDS; i++) blocked[layer * MASK_WORDS + i] = stops[i];  // read as far as `traced` says
#endif

    float t[COEFFICIENTS];
    uint mask[MASK_WORDS];
    for (int i = 0; i < COEFFICIENTS; i++) t[i] = 0.0f;
    for (int i = 0; i < MASK_WORDS; i++) mask[i] = 0;
    float sky = 0.0f;
    float blocked_sky = 0.0f;
    if (valid) {
        sh_basis(normal.xyz, t);
        for (int l = 0; l < BANDS; l++)
            for (int i = l * l; i < (l + 1) * (l + 1); i++) t[i] *= lambert_band(l);
        for (int j = 0; j < count; j++) {
            const int index = set[j % INTERLEAVE] * count + j;
            const float share = dot(normal.xyz, directions[index].xyz) * directions[index].w * M_1_PI_F;
            if (share <= 0.0f) continue;
            sky += share;
            if ((stops[j >> 5] >> (j & 31)) & 1) {
                blocked_sky += share;
                for (int i = 0; i < COEFFICIENTS; i++) t[i] -= share * basis[index * COEFFICIENTS + i];
            } else {
                mask[j >> 5] |= 1u << (j & 31);
            }
        }
    }
    for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = t[i];
    for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = mask[i];
    for (int i = 0; i < INTERLEAVE; i++) sets[sample * INTERLEAVE + i] = set[i];
    flatness[sample] = normal.w;
#ifdef HAS_CACHE
    mean_normals[sample] = normal;
#endif
    openness[sample] = valid && sky > 0.0f ? 1.0f - blocked_sky / sky : -1.0f;
}
