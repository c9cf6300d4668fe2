// Lights inside the room: what samples see of the sky and of points in space, and the picture without the lamps' light.
// Provides find_samples, pool_sky, see_emitters, remove_lamps.
#include "direction_sets.clh"
#include "smooth_normal.clh"
#include "visibility.clh"

#define LABEL_STATIC 1
#define POOL 4

#ifdef LOBES
#if LOBES % 8
#error LOBES must be a multiple of 8
#endif

// Whether a pixel and the 8 around it show static surface, neither clipped nor black; -> their mean colour.
static int usable_pixel(const int width, const int height, global const float4 *radiance, global const uchar *labels,
                        const int x, const int y, float3 *color) {
    float4 sum = (float4)(0.0f);
    int usable = 1;
    for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
            const int pixel = clamp(y + dy, 0, height - 1) * width + clamp(x + dx, 0, width - 1);
            usable = usable && radiance[pixel].w > 0.0f && labels[pixel] == LABEL_STATIC;
            sum += radiance[pixel];
        }
    }
    *color = sum.xyz / 9.0f;
    return usable;
}

// Which samples pool_sky can use, if they see enough of the sky. One item a sample; radius: see smooth_normal.clh.
// -> openness [rows][cols]: -1, usable [rows][cols]: 1 where it is.
kernel void find_samples(const int cols, const int rows, const int stride, const int width, const int height, const int radius,
                         global const float4 *positions, global const float4 *normals, global const uchar *labels,
                         global const float4 *radiance, const float least_flatness, const float voxel_m,
                         global float *openness, global uchar *usable) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int x = stride / 2 + col * stride, y = stride / 2 + row * stride;
    const int pixel = y * width + x;
    float3 color;
    const int found = positions[pixel].w > 0.0f && normals[pixel].w > 0.0f &&
                      usable_pixel(width, height, radiance, labels, x, y, &color) &&
                      smooth_normal(width, height, positions, normals, x, y, radius, voxel_m).w >= least_flatness;
    usable[row * cols + col] = found;
    openness[row * cols + col] = -1.0f;
}

// One item a pool of 4 x 4 samples, which traced 16 direction sets: an even lattice together. Members lie on the surface
// of the first usable one. Samples: as transfer_radiance left them. lobes [256][count][LOBES]: radiance of each lobe
// along each direction. -> of each pool [pool_rows][pool_cols]: mean position (volume space metres; w = share of samples
// in it, 0 = unusable), mean normal (unit), mean colour, and transfer of the lobes over white [LOBES].
kernel void pool_sky(const int pool_cols, const int pool_rows, const int cols, const int stride, const int width, const int height,
                     global const float4 *positions, global const float4 *normals, global const uchar *labels,
                     global const float4 *radiance, global const float *openness, global const float *flatness,
                     const float least_openness, const float least_flatness, const float voxel_m,
                     const int count, const int words, global const float4 *directions, global const float *lobes,
                     global const uint *free_mask,
                     global float4 *pooled_positions, global float4 *pooled_normals, global float4 *pooled_colors,
                     global float *pooled_sky) {
    const int pool_col = get_global_id(0);
    const int pool_row = get_global_id(1);
    if (pool_col >= pool_cols || pool_row >= pool_rows) return;
    float4 position = (float4)(0.0f), first = (float4)(0.0f), first_normal = (float4)(0.0f);
    float3 normal = (float3)(0.0f), color = (float3)(0.0f);
    int members = 0;  // a bit each
    for (int k = 0; k < POOL * POOL; k++) {
        const int row = pool_row * POOL + k / POOL, col = pool_col * POOL + k % POOL;
        const int sample = row * cols + col;
        const int x = stride / 2 + col * stride, y = stride / 2 + row * stride;
        float3 here;
        if (openness[sample] < least_openness || flatness[sample] < least_flatness) continue;
        if (!usable_pixel(width, height, radiance, labels, x, y, &here)) continue;
        const float4 p = positions[y * width + x], n = normals[y * width + x];
        if (!members) {
            first = p;
            first_normal = n;
        }
        const float3 offset = p.xyz - first.xyz;
        if (dot(n.xyz, first_normal.xyz) < 0.9f) continue;
        if (fabs(dot(offset, first_normal.xyz)) > voxel_m + 0.1f * length(offset)) continue;
        members |= 1 << k;
        position += (float4)(p.xyz, 1.0f);
        normal += n.xyz;
        color += here;
    }
    const float share = 1.0f / fmax(position.w, 1.0f);
    normal = members ? normalize(normal) : normal;

    float8 sky[LOBES / 8];
    for (int i = 0; i < LOBES / 8; i++) sky[i] = (float8)(0.0f);
    for (int k = 0; k < POOL * POOL; k++) {
        if (!((members >> k) & 1)) continue;
        const int row = pool_row * POOL + k / POOL, col = pool_col * POOL + k % POOL;
        const int set = direction_set(row, col) * count;
        for (int j = 0; j < count; j++) {
            if (!((free_mask[(row * cols + col) * words + (j >> 5)] >> (j & 31)) & 1)) continue;
            const float4 direction = directions[set + j];
            const float weight = fmax(dot(normal, direction.xyz), 0.0f) * direction.w * (share * M_1_PI_F);
            for (int i = 0; i < LOBES / 8; i++) sky[i] += weight * vload8(i, lobes + (set + j) * LOBES);
        }
    }
    const int pool = pool_row * pool_cols + pool_col;
    pooled_positions[pool] = (float4)(position.xyz * share, position.w / (POOL * POOL));
    pooled_normals[pool] = (float4)(normal, 0.0f);
    pooled_colors[pool] = (float4)(color * share, 0.0f);
    for (int i = 0; i < LOBES / 8; i++) vstore8(sky[i], i, pooled_sky + pool * LOBES);
}
#endif

// g = V max(n.w, 0) / (pi d^2) of LANES surface points from `first` on of an emitter at `emitter`: its light over white
// is intensity times g. A ray ends a voxel off the surface (fig. 7.5), and what is within `clearance_m` of the emitter is
// taken for the lamp itself.
static inline floatn emitter_shares(const Volume volume, const float3 emitter, const float clearance_m,
                                    global const float4 *positions, global const float4 *normals, const intn points) {
    global const float *p = (global const float *)positions;
    global const float *n = (global const float *)normals;
    const intn at = 4 * points;
    const Vectors normal = {GATHER_FLOATN(n, at), GATHER_FLOATN(n, at + 1), GATHER_FLOATN(n, at + 2)};
    const Vectors away = {GATHER_FLOATN(p, at) - emitter.x, GATHER_FLOATN(p, at + 1) - emitter.y, GATHER_FLOATN(p, at + 2) - emitter.z};
    const floatn squared = away.x * away.x + away.y * away.y + away.z * away.z;
    const floatn facing = -(away.x * normal.x + away.y * normal.y + away.z * normal.z);
    const intn lit = MASK(facing > 0.0f) & MASK(squared > 1e-8f);
    const float lift = volume.voxel_m;
    const Vectors target = {away.x + lift * normal.x, away.y + lift * normal.y, away.z + lift * normal.z};
    const floatn distance = fmax(sqrt(target.x * target.x + target.y * target.y + target.z * target.z), 1e-6f);
    const floatn scale = 1.0f / distance;
    const Vectors direction = {target.x * scale, target.y * scale, target.z * scale};
    const Rays rays = make_rays(emitter / volume.voxel_m, direction);
    floatn begin, end;
    clip_rays(volume, rays, &begin, &end);
    begin = fmax(begin, clearance_m / volume.voxel_m);
    end = fmin(end, distance / volume.voxel_m);
    end = lit ? end : 0.0f;
    const intn open = MASK(find_solid_voxels(volume, rays, begin, end) >= end) & lit;
    const floatn safe = lit ? squared : 1.0f;
    return open ? facing / (M_PI_F * safe * sqrt(safe)) : 0.0f;
}

// One item LANES points and one emitter. positions, normals [points] volume space; emitters [emitters] likewise.
// -> shares [emitters][points]: g of emitter_shares.
kernel void see_emitters(const int points, const int emitters, global const float4 *positions, global const float4 *normals,
                         global const float4 *emitter_positions, const float clearance_m,
                         VOLUME_PARAMETERS, global float *shares) {
    const int first = get_global_id(0) * LANES;
    const int emitter = get_global_id(1);
    if (first >= points || emitter >= emitters) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const intn chosen = min(first + CONVERT_INTN(LANE_NUMBERS), points - 1);
    const floatn found = emitter_shares(volume, emitter_positions[emitter].xyz, clearance_m, positions, normals, chosen);
    float each[LANES];
    STORE_LANES(found, each);
    for (int lane = 0; lane < LANES && first + lane < points; lane++) shares[emitter * points + first + lane] = each[lane];
}

// The picture without the light of the lamps: radiance less albedo times the lamps' light, not below zero; what is known
// of a pixel (w) stays. One item LANES pixels of [pixels]. lamps [count][2]: position (volume space), intensity (rgb).
kernel void remove_lamps(const int pixels, const int count, global const float4 *positions, global const float4 *normals,
                         global const float4 *lamps, const float clearance_m, const float albedo,
                         VOLUME_PARAMETERS, global const float4 *radiance, global float4 *without) {
    const int first = get_global_id(0) * LANES;
    if (first >= pixels) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const intn chosen = min(first + CONVERT_INTN(LANE_NUMBERS), pixels - 1);
    float3 arriving[LANES];
    for (int lane = 0; lane < LANES; lane++) arriving[lane] = (float3)(0.0f);
    for (int k = 0; k < count; k++) {
        float each[LANES];
        STORE_LANES(emitter_shares(volume, lamps[2 * k].xyz, clearance_m, positions, normals, chosen), each);
        for (int lane = 0; lane < LANES; lane++) arriving[lane] += each[lane] * lamps[2 * k + 1].xyz;
    }
    for (int lane = 0; lane < LANES && first + lane < pixels; lane++) {
        const float4 seen = radiance[first + lane];
        const float known = positions[first + lane].w;
        const float3 rest = known > 0.0f ? fmax(seen.xyz - albedo * arriving[lane], 0.0f) : seen.xyz;
        without[first + lane] = (float4)(rest, seen.w);
    }
}
