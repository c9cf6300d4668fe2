// Shadow maps along the sharp lights of a room and what these lights bring past them (thesis 7.2.3, fig. 7.7).
// Provides begin_map, halve_maps, trace_discs, light_virtual, light_real, light_glow, light_samples, mix_direct,
// unmix_direct.
#include "camera.clh"
#include "clear_origin.clh"
#include "continued.clh"
#include "direct_lights.clh"
#include "direct_mix.clh"
#include "rays.clh"
#include "sampled_value.clh"

#define RAYS 8  // of a sample to a disc; neighbours have others
#define RAY_SETS 16

// nearest [MAP_SIDE][MAP_SIDE]: bits of 1 / depth of objects drawn from distance_m before the ball's middle, 0 where there is none
// -> level 0 of the map of `light`.
kernel void begin_map(const int light, const float distance_m, global const uint *nearest, global float2 *maps) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= MAP_SIDE || y >= MAP_SIDE) return;
    const float inverse = as_float(nearest[y * MAP_SIDE + x]);
    maps[light * MAP_TEXELS + y * MAP_SIDE + x] = inverse > 0.0f ? (float2)(1.0f, 1.0f / inverse - distance_m) : (float2)(0.0f);
}

// `level` of all maps from the one before.
kernel void halve_maps(const int count, const int level, global float2 *maps) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    const int side = MAP_SIDE >> level;
    if (x >= side || y >= side || (int)get_global_id(2) >= count) return;
    global float2 *map = maps + get_global_id(2) * MAP_TEXELS;
    global const float2 *finer = map + level_offset(level - 1);
    float covered = 0.0f, sum = 0.0f;
    for (int i = 0; i < 4; i++) {
        const float2 texel = finer[(2 * y + (i >> 1)) * 2 * side + 2 * x + (i & 1)];
        covered += texel.x;
        sum += texel.x * texel.y;
    }
    map[level_offset(level) + y * side + x] = (float2)(0.25f * covered, covered > 0.0f ? sum / covered : 0.0f);
}

#define TRACE_PARAMETERS \
    const int4 bricks, global const int *slots, global const uchar *gaps, global const ulong *solid, global const uchar *octets, \
        global const float2 *voxels, const float voxel_m, const float truncation_m, const float reach_m, const int plane_count, \
        global const float4 *planes, global const int4 *shapes, global const uchar *plane_maps, const float cell_m, \
        const float least_m, global const float2 *ray_places
#define VOLUME_OF_TRACE make_volume(bricks, voxel_m, truncation_m, slots, gaps, solid, octets, voxels)
#define PLANES_OF_TRACE {plane_count, planes, shapes, plane_maps, cell_m, least_m}

// The part of what a disc brings to the surface that real things leave, along RAYS rays to places [RAYS] in the unit disc.
static float real_part(const Volume volume, const Continued continued, const float reach_m, const Seen seen, global const float4 *axes,
                       const float3 position, const float3 origin, global const float2 *places) {
    const float3 right = axes[0].xyz, down = axes[1].xyz, toward = axes[2].xyz;
    float all = 0.0f, free = 0.0f;
    for (int first = 0; first < RAYS; first += LANES) {
        float dx[LANES], dy[LANES], dz[LANES], cosines[LANES], left[LANES];
        float above = 0.0f;
        for (int lane = 0; lane < LANES; lane++) {
            const float2 place = places[first + lane];
            const float3 direction = normalize(toward + seen.tangent * (place.x * right + place.y * down));
            dx[lane] = direction.x, dy[lane] = direction.y, dz[lane] = direction.z;
            cosines[lane] = cosine_of_part(seen, place);
            above += cosines[lane];
        }
        if (above <= 0.0f) continue;
        const Vectors directions = {LOAD_LANES(dx), LOAD_LANES(dy), LOAD_LANES(dz)};
        const Rays rays = make_rays(origin / volume.voxel_m, directions);
        floatn begin, end;
        clip_rays(volume, rays, &begin, &end);
        end = fmin(end, reach_m / volume.voxel_m);
        STORE_LANES(MASK(find_solid_voxels(volume, rays, begin, end) >= end) ? (floatn)(1.0f) : (floatn)(0.0f), left);
        for (int lane = 0; lane < LANES; lane++)
            if (left[lane] > 0.0f && cosines[lane] > 0.0f && !is_hidden(continued, position, (float3)(dx[lane], dy[lane], dz[lane])))
                free += cosines[lane];
        all += above;
    }
    return all > 0.0f ? free / all : 1.0f;
}

static float4 real_parts(const Volume volume, const Continued continued, const float reach_m, const DirectLights lights,
                         const float3 position, const float3 normal, const int is_virtual, global const float2 *places) {
    const float3 origin = is_virtual ? clear_origin(volume, position, normal) : position + volume.voxel_m * normal;
    float parts[4] = {1.0f, 1.0f, 1.0f, 1.0f};
    for (int k = 0; k < lights.count; k++)
        parts[k] = real_part(volume, continued, reach_m, seen_by_disc(lights, k, position, normal, is_virtual), lights.rows + 4 * k,
                             position, origin, places);
    return vload4(0, parts);
}

// Samples of a surface, every `stride` pixels: positions, normals [h][w] (w = 0 without surface). ray_places [RAY_SETS][RAYS].
// -> parts [rows][cols]: of what each disc brings, the part that real things leave (xyz: discs 0 to 2, w = 1 valid).
kernel void trace_discs(const int cols, const int rows, const int stride, const int width, global const float4 *positions,
                        global const float4 *normals, const int is_virtual, DIRECT_PARAMETERS, TRACE_PARAMETERS, global float4 *parts) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 position = positions[pixel], normal = normals[pixel];
    const Volume volume = VOLUME_OF_TRACE;
    const Continued continued = PLANES_OF_TRACE;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    float4 result = (float4)(0.0f);
    if (position.w > 0.0f && normal.w > 0.0f)
        result = real_parts(volume, continued, reach_m, lights, position.xyz, normal.xyz, is_virtual,
                            ray_places + RAYS * ((row & 3) * 4 + (col & 3)));
    parts[row * cols + col] = result;
}

// What the discs bring to white surface. parts: xyz of trace_discs. with: also past objects.
static inline float3 brought(const DirectLights lights, const float3 position, const float3 normal, const int is_virtual,
                             const float4 parts, float3 *with) {
    float3 without = (float3)(0.0f);
    const float part[3] = {parts.x, parts.y, parts.z};
    *with = without;
    for (int k = 0; k < lights.count; k++) {
        const Seen seen = seen_by_disc(lights, k, position, normal, is_virtual);
        const float open = part[k] > 0.0f ? part[k] * open_part(lights, seen, k) : 0.0f;
        if (open <= 0.0f) continue;
        without += open * lights.rows[4 * k + 3].xyz;
        *with += open * free_part(lights, seen) * lights.rows[4 * k + 3].xyz;
    }
    return without;
}

// positions, normals [h][w] (w = 1 where covered): the virtual geometry buffer; parts [rows][cols]: of trace_discs
// -> direct [h][w]: what reaches white surface, 0 elsewhere.
kernel void light_virtual(const int width, const int height, global const float4 *positions, global const float4 *normals,
                          const int cols, const int rows, const int stride, global const float4 *parts, const float tolerance_m,
                          DIRECT_PARAMETERS, global float4 *direct) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const float4 position = positions[pixel];
    float3 with = (float3)(0.0f);
    if (position.w > 0.0f) {
        const DirectLights lights = DIRECT_OF_PARAMETERS;
        const Grid grid = {cols, rows, stride, width};
        float4 left = upsample(grid, parts, positions, normals, x, y, tolerance_m);
        if (left.w <= 0.0f) left = (float4)(1.0f);
        brought(lights, position.xyz, normals[pixel].xyz, 1, left, &with);
    }
    direct[pixel] = (float4)(with, 0.0f);
}

// positions, normals [h][w]: real surface; parts [rows][cols]: of trace_discs; ratio, rest [rows][cols], refined [h][w]: R' / R and R
// of the rest of the light, see composite.cl; touched: of mark_touched for `ratio`; least: see direct_mix.clh
// -> mixed [h][w]: R' / R of all of the light (rgb), w = 1 where it may be other than 1, else all 0.
kernel void light_real(const int width, const int height, global const float4 *positions, global const float4 *normals,
                       const int cols, const int rows, const int stride, global const float4 *parts, const float tolerance_m,
                       global const float4 *ratio, const int has_refined, global const float4 *refined, global const float4 *rest,
                       global const uchar *touched, const float4 least, DIRECT_PARAMETERS, global float4 *mixed) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const float4 position = positions[pixel], normal = normals[pixel];
    float4 result = (float4)(0.0f);
    if (position.w > 0.0f && normal.w > 0.0f) {
        const DirectLights lights = DIRECT_OF_PARAMETERS;
        int any = touched[(cell_of(y, stride) + 1) * (cols + 1) + cell_of(x, stride) + 1];
        for (int k = 0; k < lights.count && !any; k++)
            any = object_ahead(lights, seen_by_disc(lights, k, position.xyz, normal.xyz, 0)) > 0.0f;
        if (any) {
            const Grid grid = {cols, rows, stride, width};
            float4 means[3];  // R of the rest, what real things leave of the discs, R' / R of the rest
            float3 with;
            upsample_three(grid, rest, parts, ratio, positions, normals, x, y, tolerance_m, means);
            const float3 without = brought(lights, position.xyz, normal.xyz, 0, means[1], &with);
#ifdef BICUBIC
            means[2] = value_at(grid, ratio, refined, has_refined, positions, normals, x, y, height, tolerance_m);
#else
            if (has_refined && refined[pixel].w > 0.0f)
                means[2] = value_at(grid, ratio, refined, has_refined, positions, normals, x, y, height, tolerance_m);
#endif
            result = (float4)(mixed_ratio(means[2].xyz, means[0].xyz, without, with, least.xyz), means[2].w * means[0].w);
        }
    }
    mixed[pixel] = result;
}

// Points on virtual objects send more: points, normals (volume space), albedos [points_count]; radiances [points_count] are added to.
kernel void light_glow(const int points_count, global const float4 *points, global const float4 *normals, global const float4 *albedos,
                       DIRECT_PARAMETERS, TRACE_PARAMETERS, global float4 *radiances) {
    const int index = get_global_id(0);
    if (index >= points_count) return;
    const Volume volume = VOLUME_OF_TRACE;
    const Continued continued = PLANES_OF_TRACE;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    const float3 position = points[index].xyz, normal = normals[index].xyz;
    float3 with;
    const float4 parts = real_parts(volume, continued, reach_m, lights, position, normal, 1, ray_places + RAYS * (index & 15));
    brought(lights, position, normal, 1, parts, &with);
    radiances[index].xyz += albedos[index].xyz * with;
}

// Samples of real surface, every `stride` pixels: positions, normals [h][w]; parts [rows][cols]: of trace_discs
// -> without, with [rows][cols]: what the discs bring to white surface without and with objects (rgb).
kernel void light_samples(const int cols, const int rows, const int stride, const int width, global const float4 *positions,
                          global const float4 *normals, global const float4 *parts, DIRECT_PARAMETERS,
                          global float4 *without, global float4 *with) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int sample = row * cols + col;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    float3 before = (float3)(0.0f), after = before;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    if (parts[sample].w > 0.0f) before = brought(lights, positions[pixel].xyz, normals[pixel].xyz, 0, parts[sample], &after);
    without[sample] = (float4)(before, 1.0f);
    with[sample] = (float4)(after, 1.0f);
}

// ratio, shaded [count]: R' / R and R of the rest of the light (w = 1 valid); without, with: what its discs bring
// -> whole, whole_shaded: R' / R and R of both together. least: see direct_mix.clh.
kernel void mix_direct(const int count, const float4 least, global const float4 *ratio, global const float4 *shaded,
                       global const float4 *without, global const float4 *with, global float4 *whole, global float4 *whole_shaded) {
    const int i = get_global_id(0);
    if (i >= count) return;
    whole[i] = (float4)(mixed_ratio(ratio[i].xyz, shaded[i].xyz, without[i].xyz, with[i].xyz, least.xyz), ratio[i].w);
    whole_shaded[i] = (float4)(fmax(shaded[i].xyz, least.xyz) + without[i].xyz, shaded[i].w);
}

// The other way: the ratio of the rest, from that of both.
kernel void unmix_direct(const int count, const float4 least, global const float4 *whole, global const float4 *shaded,
                         global const float4 *without, global const float4 *with, global float4 *ratio) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const float3 rest = fmax(shaded[i].xyz, least.xyz);
    ratio[i] = (float4)((whole[i].xyz * (rest + without[i].xyz) - with[i].xyz) / rest, whole[i].w);
}
