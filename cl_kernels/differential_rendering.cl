// Differential rendering (thesis 7.1): how virtual objects change the light that reaches real and virtual surfaces.
// Provides shadow_real, shadow_virtual.
//
// Equation 7.1 adds the difference of two shadings R and R' to the picture scaled by the picture itself. For a Lambertian
// surface the picture is albedo times R, so the factor that leaves the albedo alone is R' / R; it needs no tone mapper.
#include "direction_sets.clh"
#include "sh.clh"
#include "shadows.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif
#ifndef INTERLEAVE
#define INTERLEAVE 1
#endif

// Real surface: the ratio R' / R of shading with virtual objects to shading without, at the samples of the transfer.
// transfer [rows][cols][COEFFICIENTS], free_mask [rows][cols][MASK_WORDS], sets [rows][cols][INTERLEAVE]: see radiance_transfer.cl.
// ball: center and radius of a ball around all objects. light [COEFFICIENTS] rgb; directions [64][count] (unit, sr), arriving [64][count]: radiance of the light from each of them.
// -> ratio [rows][cols] (rgb, w = 1), w = 0 where there is no surface.
kernel void shadow_real(const int cols, const int rows, const int stride, const int width,
                        global const float4 *positions, global const float4 *normals, global const float *transfer,
                        global const uint *free_mask, global const uchar *sets, global const float4 *light, const int count,
                        global const float4 *directions, global const float4 *arriving, const float reach_m,
                        const int objects, global const float16 *grid_from_volume, global const int4 *dims,
                        global const float *distances, const float4 ball, const float offset_m, global float4 *ratio) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int sample = row * cols + col;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 normal = normals[pixel];
    if (positions[pixel].w <= 0.0f || normal.w <= 0.0f) {
        ratio[sample] = (float4)(0.0f);
        return;
    }
    const float3 origin = positions[pixel].xyz + offset_m * normal.xyz;
    float3 without = (float3)(0.0f);
    for (int i = 0; i < COEFFICIENTS; i++) without += transfer[sample * COEFFICIENTS + i] * light[i].xyz;
    float3 towards;
    const float least_cosine = ball_cosine(ball, origin, &towards) - 1e-4f;
    float3 taken = (float3)(0.0f);
    for (int j = 0; j < count; j++) {
        const int index = sets[sample * INTERLEAVE + j % INTERLEAVE] * count + j;
        const float4 direction = directions[index];
        if (dot(direction.xyz, towards) < least_cosine) continue;
        if (!((free_mask[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1)) continue;
        if (trace_objects(objects, grid_from_volume, dims, distances, origin, direction.xyz, reach_m) > 0.0f) continue;
        taken += fmax(dot(normal.xyz, direction.xyz), 0.0f) * direction.w * M_1_PI_F * arriving[index].xyz;
    }
    const float3 floor = LEAST_SHADING * 0.28209479f * light[0].xyz + 1e-9f;
    ratio[sample] = (float4)(fmax(without - taken, floor) / fmax(without, floor), 1.0f);
}

// Virtual surface: the radiance that real and virtual occluders take from it, at every `stride`-th pixel it covers.
// positions, normals [h][w] (w = 1 where covered): the virtual geometry buffer. -> occluded [rows][cols] (rgb, w = 1 valid).
kernel void shadow_virtual(const int cols, const int rows, const int stride, const int width,
                           global const float4 *positions, global const float4 *normals,
                           const int4 bricks, global const int *slots, global const uchar *gaps, global const ulong *solid,
                           global const uchar *octets, global const float2 *voxels, const float voxel_m,
                           const float truncation_m, const int count, global const float4 *directions,
                           global const float4 *arriving, const float reach_m, const int plane_count,
                           global const float4 *planes, global const int4 *shapes, global const uchar *maps, const float cell_m,
                           const float least_m, const int objects, global const float16 *grid_from_volume, global const int4 *dims,
                           global const float *distances, const float offset_m, global float4 *occluded) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const Volume volume = make_volume(bricks, voxel_m, truncation_m, slots, gaps, solid, octets, voxels);
    const Objects things = {objects, grid_from_volume, dims, distances, offset_m};
    const Arriving light = {count, directions, arriving, reach_m, {plane_count, planes, shapes, maps, cell_m, least_m}};
    occluded[row * cols + col] = taken_from_virtual(volume, things, light, positions[pixel], normals[pixel].xyz, direction_set(row, col));
}
