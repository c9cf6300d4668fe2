// The hybrid depth picture (thesis 4.2.2): merging and hole filling D' (eq. 4.1-4.3), noise filter D'' (eq. 4.4) and
// smoothing filter D''' (eq. 4.5). One work-item does eight pixels along x; a depth of 0 is unknown.
// Provides lay_out, compare_depth, merge_depth, align_depth, smooth_depth.
#include "agreement.clh"
#include "camera.clh"
#include "median.clh"
#include "planes.clh"
#include "volume.clh"

#define HOLE_STEP 4      // k = 17: Omega_k of eq. 4.3 is 17 x 17 pixels, subsampled to 5 x 5
#define LEAST_SUPPORT 4  // samples on a straight line through the window; fewer are no evidence
#define OUTSIDE -1000.0f // an intensity similar to no other

// Eq. 4.1 for eight pixels: -1 where the neighbour has a similar intensity, else 0.
static inline int8 is_similar(const float8 shade, const float8 here, const float lambda_intensity) {
    return fabs(shade - here) < lambda_intensity;
}

// Weight of the voxel at a point of the volume: number of frames that have seen it.
static float weight_at(const int4 bricks, global const int *slots, global const float2 *voxels, const float3 point) {
    const int3 voxel = convert_int3(point);
    const int3 brick = voxel >> 3;
    if (point.x < 0.0f || point.y < 0.0f || point.z < 0.0f || !inside_bricks(bricks, brick)) return 0.0f;
    const int slot = slots[brick_index(bricks, brick)];
    const int3 within = voxel & 7;
    return slot < 0 ? 0.0f : voxels[slot * BRICK_VOXELS + (within.z * BRICK + within.y) * BRICK + within.x].y;
}

// Over the bordered planes. depth_m, radiance, positions (of the volume's surface, w = 0 none) [h][w] -> measured: D_C;
// predicted: D_X; shade: intensity, the square root of the luminance. Borders are 0, also those of sensed, merged and
// aligned, whose inside later kernels write.
kernel void lay_out(const int width, const int height, const int pitch, global const float *depth_m,
                    global const float4 *radiance, global const float4 *positions, const float16 camera_from_volume,
                    global float *measured, global float *predicted, global float *shade, global float *sensed,
                    global float *merged, global float *aligned) {
    const int x = (int)get_global_id(0) - BORDER;
    const int y = (int)get_global_id(1) - BORDER;
    if (x >= pitch - BORDER || y >= height + BORDER) return;
    const int at = plane_index(pitch, x, y);
    if (x < 0 || y < 0 || x >= width || y >= height) {
        measured[at] = predicted[at] = sensed[at] = merged[at] = aligned[at] = 0.0f;
        shade[at] = OUTSIDE;
        return;
    }
    const int pixel = y * width + x;
    const float4 surface = positions[pixel];
    const float3 color = radiance[pixel].xyz;
    measured[at] = depth_m[pixel];
    predicted[at] = surface.w > 0.0f ? fmax(transform_point(camera_from_volume, surface.xyz).z, 0.0f) : 0.0f;
    shade[at] = sqrt(fmax(0.2126f * color.x + 0.7152f * color.y + 0.0722f * color.z, 0.0f));
}

// -1 where one of eight pixels mixes two surfaces, as sensors do at silhouettes: at most two of its eight neighbours are on its
// own surface, and there are both nearer and farther ones.
static int8 is_mixed(global const float *measured, const int pitch, const int at, const float8 here) {
    const float8 near = SAME_SURFACE_M(here);
    int8 own = 0, nearer = 0, farther = 0;
#pragma unroll
    for (int i = 0; i < 9; i++) {
        const float8 there = vload8(0, measured + at + (i / 3 - 1) * pitch + i % 3 - 1);
        const int8 known = there > 0.0f;
        own -= known & (fabs(there - here) < near);
        nearer |= known & (there <= here - near);
        farther |= known & (there >= here + near);
    }
    return (own <= 3) & nearer & farther;
}

// -1 where the sensor agrees with the volume: at the pixel within lambda_D, and on the mean of the agreeing pixels around it
// within much less, since a mean has less noise. Otherwise a slow object would be static, with outdated normals.
static int8 agrees_with_volume(global const float *measured, global const float *predicted, const int pitch, const int at,
                               const float8 sensor, const float8 volume, const float voxel_m) {
    const int8 here = (volume > 0.0f) & (fabs(sensor - volume) < AGREEMENT_M(sensor, voxel_m));
    if (!any(here)) return here;
    float8 sum = 0.0f, count = 0.0f;
#pragma unroll
    for (int i = 0; i < 25; i++) {
        const int there = at + (i / 5 - 2) * pitch + i % 5 - 2;
        const float8 z = vload8(0, measured + there), expected = vload8(0, predicted + there);
        const float8 apart = z - expected;
        const int8 close = (z > 0.0f) & (expected > 0.0f) & (fabs(apart) < AGREEMENT_M(z, voxel_m));
        sum += as_float8(close & as_int8(apart));
        count += as_float8(close & as_int8((float8)(1.0f)));
    }
    return here & (fabs(sum) < MEAN_AGREEMENT_M(sensor, voxel_m) * count);
}

// Number of frames that have seen the volume's surface at eight pixels, where `needed`; elsewhere 0.
static float8 ages_of_surface(global const float4 *positions, const int4 bricks, global const int *slots,
                              global const float2 *voxels, const float voxel_m, const int8 needed, const int count) {
    int is_needed[8];
    float ages[8];
    vstore8(needed, 0, is_needed);
    for (int i = 0; i < 8; i++)
        ages[i] = i < count && is_needed[i] ? weight_at(bricks, slots, voxels, positions[i].xyz / voxel_m) : 0.0f;
    return vload8(0, ages);
}

// measured, predicted, positions and the volume -> sensed: D_C, negative where it agrees with the volume, 0 also where
// two surfaces are mixed; trusted: predicted, negative where sensed is 0 and fewer than `least_filling` frames have seen the
// volume's surface. Nothing agrees with surface seen by fewer than `least_still` frames: it may be a moving object, just fused.
kernel void compare_depth(const int width, const int height, const int pitch, global const float *measured,
                          global const float *predicted, global const float4 *positions, const int4 bricks, global const int *slots,
                          global const float2 *voxels, const float voxel_m, const float least_still,
                          const float least_filling, global float *trusted, global float *sensed) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int at = plane_index(pitch, x, y);
    const float8 sensor = vload8(0, measured + at), volume = vload8(0, predicted + at);
    const int8 hole = (sensor <= 0.0f) | is_mixed(measured, pitch, at, sensor);
    int8 agrees = agrees_with_volume(measured, predicted, pitch, at, sensor, volume, voxel_m);
    const int8 needed = (volume > 0.0f) & (hole | agrees);
    float8 marked = volume;
    if (any(needed)) {
        const float8 age = ages_of_surface(positions + y * width + x, bricks, slots, voxels, voxel_m, needed, min(8, width - x));
        agrees &= age >= least_still;
        marked = select(volume, -volume, needed & hole & (age < least_filling));
    }
    vstore8(marked, 0, trusted + at);
    vstore8(select(select(sensor, -sensor, agrees), (float8)(0.0f), hole), 0, sensed + at);
}

// Votes of the samples around eight pixels, `step` apart, on the volume's surface: +1 where the sensor agrees with it, -1 where
// the sensor sees farther. Only samples of the same surface vote, and none that is occluded by something nearer.
static int8 votes_for_surface(global const float *sensed, global const float *predicted, const int pitch, const int at,
                            const int step, const float8 surface, const float8 near) {
    int8 votes = 0;
#pragma unroll
    for (int i = 0; i < 25; i++) {
        const int there = at + (i / 5 - 2) * step * pitch + (i % 5 - 2) * step;
        const int8 key = as_int8(vload8(0, sensed + there));
        const float8 expected = vload8(0, predicted + there);
        const int8 same = (fabs(expected - surface) < near) & (key != 0);
        votes += (same & (as_float8(key) > expected)) - (same & (key < 0));  // masks are -1
    }
    return votes;
}

// Depth of eight holes (third and fourth case of eq. 4.3): the median of the supporting neighbours if there are enough, and if
// most of them disagree with the volume or the volume is not reliable; else the volume. It is not reliable where too few frames
// have seen its surface, or where the sensor contradicts most of that surface around the pixel.
static int8 fill_holes(global const float *sensed, global const float *predicted, global const float *shade, const int pitch,
                       const int at, const float voxel_m, const float lambda_intensity) {
    const float8 here = vload8(0, shade + at), surface = vload8(0, predicted + at);
    const float8 near = AGREEMENT_M(surface, voxel_m);
    int8 values[25], pad = FIRST_PAD, count = 0, agreeing = 0;
#pragma unroll
    for (int i = 0; i < 25; i++) {
        const int there = at + (i / 5 - 2) * HOLE_STEP * pitch + (i % 5 - 2) * HOLE_STEP;
        const int8 key = as_int8(vload8(0, sensed + there));
        const int8 support = is_similar(vload8(0, shade + there), here, lambda_intensity) & (key != 0);
        values[i] = pad_unless(support, key & INT_MAX, &pad);
        count -= support;
        agreeing -= support & (key < 0);
    }
    const int8 votes = votes_for_surface(sensed, predicted, pitch, at, HOLE_STEP, surface, near) +
                       votes_for_surface(sensed, predicted, pitch, at, HOLE_STEP / 2, surface, near);
    const int8 known = (surface > 0.0f) & (votes >= 0);
    const int8 filled = (count >= LEAST_SUPPORT) & ((2 * agreeing < count) | ~known);
    return select(known & as_int8(surface), middle_of(values, 25), filled);
}

// D' (eq. 4.3): sensed, predicted (`trusted` of compare_depth), shade -> merged.
kernel void merge_depth(const int width, const int height, const int pitch, global const float *sensed,
                        global const float *predicted, global const float *shade, const float voxel_m,
                        const float lambda_intensity, global float *merged) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int at = plane_index(pitch, x, y);
    const int8 key = as_int8(vload8(0, sensed + at));
    int8 result = select(key, as_int8(vload8(0, predicted + at)), key < 0);
    if (any(key == 0)) {
        const int8 filled = fill_holes(sensed, predicted, shade, pitch, at, voxel_m, lambda_intensity);
        result = select(result, filled, key == 0);
    }
    vstore8(as_float8(result), 0, merged + at);
}

// Whether any depth within `radius` rows of eight pixels, and up to four pixels beside them, is not the volume's.
static inline int any_others(global const float *depths, global const float *predicted, const int pitch, const int at,
                             const int radius) {
    int16 others = 0;
    for (int dy = -radius; dy <= radius; dy++) {
        const float16 depth = vload16(0, depths + at + dy * pitch - 4);
        others |= (depth != 0.0f) & (depth != vload16(0, predicted + at + dy * pitch - 4));
    }
    return any(others);
}

// -1 where a depth within `radius` pixels of one of eight is not the volume's.
static int8 has_others(global const float *depths, global const float *predicted, const int pitch, const int at, const int radius) {
    int8 others = 0;
    for (int dy = -radius; dy <= radius; dy++) {
        for (int dx = -radius; dx <= radius; dx++) {
            const int there = at + dy * pitch + dx;
            const float8 depth = vload8(0, depths + there);
            others |= (depth != 0.0f) & (depth != vload8(0, predicted + there));
        }
    }
    return others;
}

// D'' (eq. 4.4), a joint bilateral median over 5 x 5 pixels: merged, shade -> aligned. Unknown stays unknown. Where the whole
// window is the volume's, it has no sensor noise and is kept.
kernel void align_depth(const int width, const int height, const int pitch, global const float *merged,
                        global const float *predicted, global const float *shade, const float lambda_intensity,
                        global float *aligned) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int at = plane_index(pitch, x, y);
    if (!any_others(merged, predicted, pitch, at, 2)) {
        vstore8(vload8(0, merged + at), 0, aligned + at);
        return;
    }
    const int8 is_filtered = has_others(merged, predicted, pitch, at, 2);
    const float8 here = vload8(0, shade + at);
    int8 values[25], pad = FIRST_PAD;
#pragma unroll
    for (int i = 0; i < 25; i++) {
        const int there = at + (i / 5 - 2) * pitch + i % 5 - 2;
        const int8 key = as_int8(vload8(0, merged + there));
        const int8 member = is_similar(vload8(0, shade + there), here, lambda_intensity) & (key != 0);
        values[i] = pad_unless(member, key, &pad);
    }
    const int8 own = as_int8(vload8(0, merged + at));
    vstore8(as_float8(select(own, (own != 0) & middle_of(values, 25), is_filtered)), 0, aligned + at);
}

// D''' (eq. 4.5), a median over 3 x 3 pixels: aligned -> smoothed. Unknown stays unknown. Where at least two neighbours are on
// the pixel's own surface, the median is over these only: over all, it would round corners and remove details a pixel wide.
// Windows of the volume's depth are kept, as in D''.
kernel void smooth_depth(const int width, const int height, const int pitch, global const float *aligned,
                         global const float *predicted, global float *smoothed) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int at = plane_index(pitch, x, y);
    const float8 here = vload8(0, aligned + at);
    if (!any_others(aligned, predicted, pitch, at, 1)) {
        vstore8(here, 0, smoothed + at);
        return;
    }
    const int8 is_filtered = has_others(aligned, predicted, pitch, at, 1);
    const float8 near = SAME_SURFACE_M(here);
    int8 values[9], own[9], pad = FIRST_PAD, count = 0;
#pragma unroll
    for (int i = 0; i < 9; i++) {
        const float8 there = vload8(0, aligned + at + (i / 3 - 1) * pitch + i % 3 - 1);
        values[i] = as_int8(there);
        own[i] = (there > 0.0f) & (fabs(there - here) < near);
        count -= own[i];
    }
#pragma unroll
    for (int i = 0; i < 9; i++) values[i] = pad_unless((values[i] != 0) & (own[i] | (count < 3)), values[i], &pad);
    vstore8(as_float8(select(as_int8(here), (here > 0.0f) & middle_of(values, 9), is_filtered)), 0, smoothed + at);
}
