// Differential rendering (thesis 7.1): how virtual objects change the light that reaches real and virtual surfaces.
// Provides shadow_real, shadow_virtual.
//
// Equation 7.1 adds the difference of two shadings R and R' to the picture scaled by the picture itself. For a Lambertian
// surface the picture is albedo times R, so the factor that leaves the albedo alone is R' / R; it needs no tone mapper.
#include "direction_sets.clh"
#include "sh.clh"
#include "virtual_objects.clh"
#include "visibility.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif

// Shading below this share of the unoccluded ambient counts as this share: keeps R' / R bounded where R is near 0.
#define LEAST_SHADING 0.02f

// Cosine of the half-angle under which a ball (center, radius) is seen from a point; -1 inside it.
static inline float ball_cosine(const float4 ball, const float3 point, float3 *towards) {
    const float3 offset = ball.xyz - point;
    const float distance2 = dot(offset, offset);
    *towards = offset * rsqrt(fmax(distance2, 1e-12f));
    return distance2 > ball.w * ball.w ? sqrt(1.0f - ball.w * ball.w / distance2) : -1.0f;
}

// Real surface: the ratio R' / R of shading with virtual objects to shading without, at the samples of the transfer.
// transfer [rows][cols][COEFFICIENTS], free_mask [rows][cols][MASK_WORDS]: see radiance_transfer.cl.
// ball: center and radius of a ball around all objects. light [COEFFICIENTS] rgb; directions [64][count] (unit, sr), arriving [64][count]: radiance of the light from each of them.
// -> ratio [rows][cols] (rgb, w = 1), w = 0 where there is no surface.
kernel void shadow_real(const int cols, const int rows, const int stride, const int width,
                        global const float4 *positions, global const float4 *normals, global const float *transfer,
                        global const uint *free_mask, global const float4 *light, const int count,
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
    const int set = direction_set(row, col) * count;
    for (int j = 0; j < count; j++) {
        const float4 direction = directions[set + j];
        if (dot(direction.xyz, towards) < least_cosine) continue;
        if (!((free_mask[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1)) continue;
        if (trace_objects(objects, grid_from_volume, dims, distances, origin, direction.xyz, reach_m) > 0.0f) continue;
        taken += fmax(dot(normal.xyz, direction.xyz), 0.0f) * direction.w * M_1_PI_F * arriving[set + j].xyz;
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
                           global const float4 *arriving, const float reach_m,
                           const int objects, global const float16 *grid_from_volume, global const int4 *dims,
                           global const float *distances, const float offset_m, global float4 *occluded) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 position = positions[pixel];
    const float3 normal = normals[pixel].xyz;
    const Volume volume = make_volume(bricks, voxel_m, truncation_m, slots, gaps, solid, octets, voxels);
    float4 taken = (float4)(0.0f);
    if (position.w > 0.0f) {
        taken.w = 1.0f;
        const int set = direction_set(row, col) * count;
        int chosen[LANES];  // directions that no object blocks, until there are enough to trace
        int waiting = 0;
        for (int j = 0; j < count; j++) {
            const float4 direction = directions[set + j];
            const float cosine = dot(normal, direction.xyz);
            if (cosine > 0.0f) {
                if (trace_objects(objects, grid_from_volume, dims, distances, position.xyz + offset_m * normal, direction.xyz, reach_m) > 0.0f)
                    chosen[waiting++] = set + j;
                else
                    taken.xyz += cosine * direction.w * M_1_PI_F * arriving[set + j].xyz;
            }
            if (waiting < LANES && (j < count - 1 || waiting == 0)) continue;
            for (int lane = waiting; lane < LANES; lane++) chosen[lane] = chosen[0];
            const Rays rays = volume_rays(volume, position.xyz + voxel_m * normal, directions, chosen);
            const int open = bits_of(trace_volume(volume, rays, reach_m));
            for (int lane = 0; lane < waiting; lane++) {
                const float4 blocked = directions[chosen[lane]];
                if (!((open >> lane) & 1))
                    taken.xyz += dot(normal, blocked.xyz) * blocked.w * M_1_PI_F * arriving[chosen[lane]].xyz;
            }
            waiting = 0;
        }
    }
    occluded[row * cols + col] = taken;
}
