// Shadow maps along the sharp lights of a room, and shading with them (thesis 7.2.3, fig. 7.7).
// Provides build_maps, trace_discs, keep_parts, light_virtual, light_real, light_points_by_discs, light_samples.
#include "camera.clh"
#include "clear_origin.clh"
#include "direct_lights.clh"
#include "direct_mix.clh"
#include "groups.clh"
#include "rays.clh"
#include "samples.clh"
#include "sampled_value.clh"
#include "upsample_row.clh"

#define RAYS 8  // of a sample to a disc; neighbours have others
#define RAY_SETS 16

#define MAP_ITEMS 64
#define COARSEST (1 << LEVELS_END)
#define BLOCK (MAP_SIDE / COARSEST)  // texels of level 0 along a side of one of the coarsest

// A texel of level 0: bits of 1 / depth of what was drawn there, 0 for nothing, seen from 1 / inverse_m, or if that is 0 from
// distance_m, before the ball's centre.
static inline float2 drawn_texel(const uint bits, const float inverse_m, const float distance_m) {
    const float inverse = as_float(bits);
    const float depth = inverse_m > 0.0f ? (1.0f - inverse / inverse_m) / inverse_m : 1.0f / inverse - distance_m;
    return inverse > 0.0f ? (float2)(1.0f, depth) : (float2)(0.0f);
}

// A texel at (x, y) of `level` from the level before.
static inline void halve_texel(global float2 *map, const int level, const int x, const int y) {
    const int side = MAP_SIDE >> level;
    global const float2 *finer = map + level_offset(level - 1);
    float covered = 0.0f, sum = 0.0f;
    for (int i = 0; i < 4; i++) {
        const float2 texel = finer[(2 * y + (i >> 1)) * 2 * side + 2 * x + (i & 1)];
        covered += texel.x;
        sum += texel.x * texel.y;
    }
    map[level_offset(level) + y * side + x] = (float2)(0.25f * covered, covered > 0.0f ? sum / covered : 0.0f);
}

// nearest [lights MAP_SIDE][MAP_SIDE]: for each light, bits of 1 / depth of objects, see drawn_texel; rows: of DirectLights
// -> maps [lights][MAP_TEXELS], depths mapped. One work-group a texel of the coarsest level, with all that lies below it.
kernel __attribute__((reqd_work_group_size(MAP_ITEMS, 1, 1)))
void build_maps(const float distance_m, global const float4 *rows, global const uint *nearest, global float2 *maps) {
    const int item = get_local_id(0), light = group_number() / (COARSEST * COARSEST), block = group_number() % (COARSEST * COARSEST);
    const int2 corner = BLOCK * (int2)(block % COARSEST, block / COARSEST);
    const float inverse_m = rows[4 * light].w;
    global float2 *map = maps + light * MAP_TEXELS;
    for (int i = item; i < BLOCK * BLOCK; i += MAP_ITEMS) {
        const int texel = (corner.y + i / BLOCK) * MAP_SIDE + corner.x + i % BLOCK;
        map[texel] = drawn_texel(nearest[light * MAP_SIDE * MAP_SIDE + texel], inverse_m, distance_m);
    }
    for (int level = 1; BLOCK >> level > 0; level++) {
        barrier(CLK_GLOBAL_MEM_FENCE);
        const int side = BLOCK >> level;
        for (int i = item; i < side * side; i += MAP_ITEMS)
            halve_texel(map, level, (corner.x >> level) + i % side, (corner.y >> level) + i / side);
    }
}

#define TRACE_PARAMETERS VOLUME_PARAMETERS, const float ray_length_m, global const float2 *ray_places

// Real surface nearer to a near disc than this is the lamp itself.
#define LAMP_M 0.1f

// Fraction of disc k's light at the surface that real surface does not block, along RAYS rays to places [RAYS] in the unit disc.
static float real_part(const Volume volume, const float ray_length_m, const DirectLights lights, const int k,
                       const float3 position, const float3 normal, const float3 origin, global const float2 *places) {
    global const float4 *axes = lights.rows + 4 * k;
    const float3 right = axes[0].xyz, down = axes[1].xyz, toward = axes[2].xyz;
    const Vectors point = {position.x, position.y, position.z}, facing = {normal.x, normal.y, normal.z};
    const Seen seen = seen_by_disc(lights, k, point, facing, 0);
    float all = 0.0f, free = 0.0f;
    for (int first = 0; first < RAYS; first += LANES) {
        floatn x, y;
        load_pairs(places + first, &x, &y);
        x = right_of(seen, x);
        y = down_of(seen, y);
        const floatn cosine = cosine_of_part(seen.normal, x, y);
        if (!ANY(MASK(cosine > 0.0f))) continue;
        const floatn shorten = 1.0f / sqrt(1.0f + x * x + y * y);
        const Vectors direction = {(toward.x + (x * right.x + y * down.x)) * shorten, (toward.y + (x * right.y + y * down.y)) * shorten,
                                   (toward.z + (x * right.z + y * down.z)) * shorten};
        const Rays rays = make_rays(origin / volume.voxel_m, direction);
        floatn begin, end;
        clip_rays(volume, rays, &begin, &end);
        end = MASK(cosine > 0.0f) ? fmin(end, ray_length_m / volume.voxel_m) : 0.0f;  // directions below the horizon are not traced
        const floatn lamp_m = 1.0f / (seen.inverse_m * seen.scale * shorten);  // infinite if it is distant
        end = fmin(end, (lamp_m - LAMP_M) / volume.voxel_m);
        const intn open = MASK(find_solid_voxels(volume, rays, begin, end) >= end);
        float cosines[LANES], left[LANES];
        STORE_LANES(cosine, cosines);
        STORE_LANES(open ? cosine : 0.0f, left);
        for (int lane = 0; lane < LANES; lane++) {
            all += cosines[lane];
            free += left[lane];
        }
    }
    return all > 0.0f ? free / all : 1.0f;
}

static float4 real_parts(const Volume volume, const float ray_length_m, const DirectLights lights,
                         const float3 position, const float3 normal, const int is_virtual, global const float2 *places) {
    const float3 origin = is_virtual ? clear_origin(volume, position, normal) : position + volume.voxel_m * normal;
    float parts[4] = {1.0f, 1.0f, 1.0f, 1.0f};
    for (int k = 0; k < lights.count; k++)
        parts[k] = real_part(volume, ray_length_m, lights, k, position, normal, origin, places);
    return vload4(0, parts);
}

// Samples `around` (x0 y0 x1 y1, half-open) of a surface: positions, normals [h][w] (w = 0 without surface). ray_places [RAY_SETS][RAYS].
// -> parts [rows][cols]: the fraction of each disc's light that real surface does not block (xyz: discs 0 to 2, w = 1 valid).
// With has_cells, samples whose cell kept its parts in frame `since` or later get those; the others ask to fill their cell's:
// cells [rows][cols] (-1 none); claims, kept, frames [cells]: see Cells.
kernel void trace_discs(const Grid grid, const int4 around, global const float4 *positions, global const float4 *normals, const int is_virtual,
                        DIRECT_PARAMETERS, TRACE_PARAMETERS, global float4 *parts,
                        const int has_cells, const int since, global const int *cells, global uint *claims, global const float4 *kept,
                        global const int *frames) {
    const int col = around.x + get_global_id(0);
    const int row = around.y + get_global_id(1);
    if (col >= around.z || row >= around.w) return;
    const int pixel = sample_pixel(grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    const int sample = row * grid.cols + col, place = has_cells ? cells[sample] : -1;
    if (place >= 0 && frames[place] >= since) {
        parts[sample] = kept[place];
        return;
    }
    if (place >= 0) atomic_min(&claims[place], (uint)sample);
    const Volume volume = VOLUME_OF_PARAMETERS;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    float4 result = (float4)(0.0f);
    if (position.w > 0.0f && normal.w > 0.0f)
        result = real_parts(volume, ray_length_m, lights, position.xyz, normal.xyz, is_virtual,
                            ray_places + RAYS * ((row & 3) * 4 + (col & 3)));
    parts[sample] = result;
}

// With has_cells, the first sample of those that asked for a cell fills it. Arguments as in trace_discs; now: number of this frame.
static inline void keep_part(const int sample, const int now, global const float4 *parts, global const int *cells, global uint *claims,
                             global float4 *kept, global int *frames) {
    const int place = cells[sample];
    if (place < 0 || claims[place] != (uint)sample) return;
    claims[place] = 0xffffffffu;
    kept[place] = parts[sample];
    frames[place] = now;
}

// The same for all samples, where light_samples does not follow. One item a sample.
kernel void keep_parts(const int count, const int now, global const float4 *parts, global const int *cells, global uint *claims,
                       global float4 *kept, global int *frames) {
    const int sample = get_global_id(0);
    if (sample < count) keep_part(sample, now, parts, cells, claims, kept, frames);
}

// The first three of four of LANES neighbours from vectors[i] on, those past `last` 0; `known` where w > 0.
static inline Vectors neighbours(global const float4 *vectors, const int i, const int last, intn *known) {
    float w[LANES];
    for (int lane = 0; lane < LANES; lane++) w[lane] = i + lane <= last ? vectors[i + lane].w : 0.0f;
    Vectors result;
    load_vectors(vectors, i, last, &result.x, &result.y, &result.z);
    *known = MASK(LOAD_LANES(w) > 0.0f);
    return result;
}

// [LANES] of a lane each, w = 0; and the other way.
static inline void lanes_of(const Vectors v, float4 *each) {
    float x[LANES], y[LANES], z[LANES];
    STORE_LANES(v.x, x);
    STORE_LANES(v.y, y);
    STORE_LANES(v.z, z);
    for (int lane = 0; lane < LANES; lane++) each[lane] = (float4)(x[lane], y[lane], z[lane], 0.0f);
}

static inline Vectors from_lanes(const float4 *each) {
    float x[LANES], y[LANES], z[LANES];
    for (int lane = 0; lane < LANES; lane++) x[lane] = each[lane].x, y[lane] = each[lane].y, z[lane] = each[lane].z;
    const Vectors v = {LOAD_LANES(x), LOAD_LANES(y), LOAD_LANES(z)};
    return v;
}

static inline void store_vectors(const Vectors v, const float w, const int i, const int last, global float4 *vectors) {
    float4 each[LANES];
    lanes_of(v, each);
    for (int lane = 0; lane < LANES && i + lane <= last; lane++) vectors[i + lane] = (float4)(each[lane].xyz, w);
}

// positions, normals [h][w] (w = 1 where covered): the virtual geometry buffer; parts [rows][cols]: of trace_discs. One item LANES
// pixels of a row of `around` (x0 y0 x1 y1, half-open). -> direct [h][w]: light on white surface, 0 without surface.
kernel void light_virtual(const Grid grid, const int4 around, global const float4 *positions, global const float4 *normals,
                          global const float4 *parts, const float tolerance_m, DIRECT_PARAMETERS, global float4 *direct) {
    const int x = around.x + get_global_id(0) * LANES;
    const int y = around.y + get_global_id(1);
    if (x >= around.z || y >= around.w) return;
    const int pixel = y * grid.width + x, last = y * grid.width + around.z - 1;
    intn covered;
    neighbours(positions, pixel, last, &covered);
    Vectors with = {0.0f, 0.0f, 0.0f};
    if (ANY(covered)) {
        const DirectLights lights = DIRECT_OF_PARAMETERS;
        const Row row = row_from(grid, positions, normals, x, y);
        intn found;
        Vectors left = upsample_row(grid, parts, positions, normals, row, tolerance_m, &found);
        left.x = found ? left.x : 1.0f;
        left.y = found ? left.y : 1.0f;
        left.z = found ? left.z : 1.0f;
        floatn ahead[MOST_LIGHTS];
        objects_ahead_of_all(lights, row.position, row.normal, 1, covered, ahead);
        with = brought_by_discs(lights, row.position, row.normal, 1, left, ahead).with;
        with.x = covered ? with.x : 0.0f;
        with.y = covered ? with.y : 0.0f;
        with.z = covered ? with.z : 0.0f;
    }
    store_vectors(with, 0.0f, pixel, last, direct);
}

// Mask of the LANES pixels in changed cells (see change_mask.cl).
static inline intn touched_lanes(global const uchar *touched, const int cols, const int stride, const int x, const int y, const int width) {
    global const uchar *row = touched + (cell_of(y, stride) + 1) * (cols + 1) + 1;
    int bits[LANES];
    for (int lane = 0; lane < LANES; lane++) bits[lane] = -(int)(x + lane < width && row[cell_of(x + lane, stride)] != 0);
    return LOAD_LANES(bits);
}

// positions, normals [h][w]: real surface; parts [rows][cols]: of trace_discs; ratio, rest [rows][cols], refined [h][w]: R' / R and R
// of the rest of the light, see composite.cl; touched: of change_mask.cl for `ratio`. One item LANES pixels
// -> mixed [h][w]: R' / R of the whole light (rgb), w = 1 where it may be other than 1, else all 0.
kernel void light_real(const Grid grid, const int height, global const float4 *positions, global const float4 *normals,
                       global const float4 *parts, const float tolerance_m, global const float4 *ratio, const int has_refined,
                       global const float4 *refined, global const float4 *rest,
                       global const uchar *touched, DIRECT_PARAMETERS, global float4 *mixed) {
    const int x = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    const int width = grid.width;
    if (x >= width || y >= height) return;
    const int pixel = y * width + x, last = y * width + width - 1;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    intn surface, faced;
    const Vectors position = neighbours(positions, pixel, last, &surface), normal = neighbours(normals, pixel, last, &faced);
    surface &= faced;
    floatn ahead[MOST_LIGHTS];
    intn wanted = objects_ahead_of_all(lights, position, normal, 0, surface, ahead);
    wanted = surface & (wanted | touched_lanes(touched, grid.cols, grid.stride, x, y, width));
    if (!ANY(wanted)) {
        const Vectors nothing = {0.0f, 0.0f, 0.0f};
        store_vectors(nothing, 0.0f, pixel, last, mixed);
        return;
    }
    const Row row = row_from(grid, positions, normals, x, y);
    floatn total = 0.0f;
    Vectors sums[3] = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};  // R of the rest, unblocked parts, R' / R
    for (int i = row.first.y; i <= row.last.y; i++) {
        for (int j = row.first.x; j <= row.last.x; j++) {
            const int sample = i * grid.cols + j;
            const float4 values[3] = {rest[sample], parts[sample], ratio[sample]};
            if (values[0].w <= 0.0f) continue;
            const floatn weight = weights_of(grid, positions, normals, row, i, j, tolerance_m);
            total += weight;
            for (int k = 0; k < 3; k++) {
                sums[k].x += weight * values[k].x;
                sums[k].y += weight * values[k].y;
                sums[k].z += weight * values[k].z;
            }
        }
    }
    const intn found = MASK(total > 1e-4f);
    const floatn share = found ? 1.0f / (found ? total : 1.0f) : 0.0f;
    for (int k = 0; k < 3; k++) sums[k].x *= share, sums[k].y *= share, sums[k].z *= share;
    const Brought sent = brought_by_discs(lights, position, normal, 0, sums[1], ahead);
    float4 of_rest[LANES], factor[LANES], without[LANES], with[LANES];
    int kept[LANES], valid[LANES];
    lanes_of(sums[0], of_rest);
    lanes_of(sums[2], factor);
    lanes_of(sent.without, without);
    lanes_of(sent.with, with);
    STORE_LANES(wanted, kept);
    STORE_LANES(found, valid);
    for (int lane = 0; lane < LANES && x + lane < width; lane++) {
        float4 result = (float4)(0.0f);
        if (kept[lane]) {
            float4 mean = (float4)(factor[lane].xyz, valid[lane] ? 1.0f : 0.0f);
#ifndef BICUBIC
            if (has_refined && refined[pixel + lane].w > 0.0f)
#endif
                mean = value_at(grid, ratio, refined, has_refined, positions, normals, x + lane, y, height, tolerance_m);
            result = (float4)(mixed_ratio(mean.xyz, of_rest[lane].xyz, without[lane].xyz, with[lane].xyz, discs.least.xyz),
                              valid[lane] ? mean.w : 0.0f);
        }
        mixed[pixel + lane] = result;
    }
}

// Adds the discs' light to radiances [points_count] of points on virtual objects: points, normals (volume space), albedos
// [points_count]. One item LANES points.
kernel void light_points_by_discs(const int points_count, global const float4 *points, global const float4 *normals,
                                  global const float4 *albedos,
                       DIRECT_PARAMETERS, TRACE_PARAMETERS, global float4 *radiances) {
    const int first = get_global_id(0) * LANES;
    if (first >= points_count) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    float left[3][LANES];
    for (int lane = 0; lane < LANES; lane++) {
        const int index = min(first + lane, points_count - 1);
        const float4 parts = real_parts(volume, ray_length_m, lights, points[index].xyz, normals[index].xyz, 1,
                                        ray_places + RAYS * (index & 15));
        left[0][lane] = parts.x, left[1][lane] = parts.y, left[2][lane] = parts.z;
    }
    const Vectors parts = {LOAD_LANES(left[0]), LOAD_LANES(left[1]), LOAD_LANES(left[2])};
    Vectors position, normal;
    load_vectors(points, first, points_count - 1, &position.x, &position.y, &position.z);
    load_vectors(normals, first, points_count - 1, &normal.x, &normal.y, &normal.z);
    floatn ahead[MOST_LIGHTS];
    objects_ahead_of_all(lights, position, normal, 1, (intn)(-1), ahead);
    float4 with[LANES];
    lanes_of(brought_by_discs(lights, position, normal, 1, parts, ahead).with, with);
    for (int lane = 0; lane < LANES && first + lane < points_count; lane++)
        radiances[first + lane].xyz += albedos[first + lane].xyz * with[lane].xyz;
}

// Samples of real surface: positions, normals [h][w]; parts [rows][cols]: of trace_discs. One item LANES samples
// -> without, with [rows][cols]: light from the discs on white surface without and with objects (rgb). Keeps the parts (keep_part).
kernel void light_samples(const Grid grid, global const float4 *positions, global const float4 *normals, global const float4 *parts,
                          DIRECT_PARAMETERS, global float4 *without, global float4 *with,
                          const int has_cells, const int now, global const int *cells, global uint *claims, global float4 *kept,
                          global int *frames) {
    const int col = get_global_id(0) * LANES;
    const int row = get_global_id(1);
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col, last = row * grid.cols + grid.cols - 1;
    float4 at[LANES], facing[LANES];
    for (int lane = 0; lane < LANES; lane++) {
        const int pixel = sample_pixel(grid, row, min(col + lane, grid.cols - 1));
        at[lane] = positions[pixel], facing[lane] = normals[pixel];
    }
    const Vectors position = from_lanes(at), normal = from_lanes(facing);
    intn known;
    Vectors left = neighbours(parts, sample, last, &known);
    left.x = known ? left.x : 0.0f;
    left.y = known ? left.y : 0.0f;
    left.z = known ? left.z : 0.0f;
    const DirectLights lights = DIRECT_OF_PARAMETERS;
    floatn ahead[MOST_LIGHTS];
    objects_ahead_of_all(lights, position, normal, 0, known, ahead);
    const Brought sent = brought_by_discs(lights, position, normal, 0, left, ahead);
    store_vectors(sent.without, 1.0f, sample, last, without);
    store_vectors(sent.with, 1.0f, sample, last, with);
    for (int i = sample; has_cells && i <= min(sample + LANES - 1, last); i++) keep_part(i, now, parts, cells, claims, kept, frames);
}
