// Diffuse shadowed radiance transfer from depth views instead of the volume (thesis 6.2), projected to spherical harmonics.
// Provides measure_depths, smooth_normals, transfer_from_views.
#include "camera.clh"
#include "direction_sets.clh"
#include "samples.clh"
#include "sh.clh"
#include "smooth_normal.clh"
#include "lanes.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif
#define DIRECTIONS (32 * MASK_WORDS)
#define LABEL_DYNAMIC 2
#define LABEL_FILLED 3
#define FREE_BIT 0.5f  // V' above a half counts as free where only one bit is stored

// A depth view of the scene.
typedef struct {
    float16 view_from_volume;
    float4 intrinsics;
    int width, height;
    global const float *depths;
} View;

// Geometry buffer positions [h][w] (volume space, w = 1 surface), labels [h][w] -> depths [h][w]: metres along the view's axis,
// 0 = none or only filled from its neighbours, negative where only the sensor knows the surface; any_unknown: 1 if there is such
// a pixel.
kernel void measure_depths(const int width, const int height, global const float4 *positions, global const uchar *labels,
                           const float16 view_from_volume, global float *depths, global int *any_unknown) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const float4 p = positions[pixel];
    const float depth = p.w > 0.0f && labels[pixel] != LABEL_FILLED ? fmax(transform_point(view_from_volume, p.xyz).z, 0.0f) : 0.0f;
    const int unknown = depth > 0.0f && labels[pixel] == LABEL_DYNAMIC;
    if (unknown) *any_unknown = 1;
    depths[pixel] = unknown ? -depth : depth;
}

static inline Vectors turned(const float16 m, const Vectors v) {
    const Vectors result = {m.s0 * v.x + (m.s1 * v.y + m.s2 * v.z), m.s4 * v.x + (m.s5 * v.y + m.s6 * v.z),
                            m.s8 * v.x + (m.s9 * v.y + m.sa * v.z)};
    return result;
}

// V' of eq. 6.3 along LANES directions w (view axes) from one point: the least over `steps` samples y at distances r, r ratio,
// ..., none beyond near_m that surface known to the volume hides, none beyond ray_length_m, and none that other surface hides
// unless has_unknown. `surface`, `normal`: the point's tangent plane, view axes. A sample is hidden where the surface s that
// the view sees on its line of sight is nearer than it by more than bias_m; s must be above the tangent plane by lift_m, or a
// flat wall would hide itself. V' is 0 where s lies along w and 1 from the threshold on. slack: s may be deeper by up to this
// fraction of r, the gap between two samples.
static floatn visibility(const View view, const float3 origin, const float3 surface, const float3 normal, const Vectors w,
                         floatn r, const float ratio, const int steps, const int has_unknown, const float near_m, const float ray_length_m,
                         const float bias_m, const float lift_m, const float slack, const float inverse_threshold) {
    const float4 lens = view.intrinsics;
    const float per_x = 1.0f / lens.s0, per_y = 1.0f / lens.s1;
    const float plane = dot(normal, surface) + lift_m;
    floatn free = 1.0f;
    for (int k = 0; k < steps; k++) {
        const Vectors y = {origin.x + r * w.x, origin.y + r * w.y, origin.z + r * w.z};
        const intn ahead = MASK(y.z > 1e-3f) & MASK(r < ray_length_m);
        const floatn inverse = 1.0f / (ahead ? y.z : 1.0f);
        const floatn u = lens.s0 * y.x * inverse + (lens.s2 + 0.5f), v = lens.s1 * y.y * inverse + (lens.s3 + 0.5f);
        const intn inside = ahead & MASK(u > 0.0f) & MASK(v > 0.0f) & MASK(u < (float)view.width) & MASK(v < (float)view.height);
        const intn col = CONVERT_INTN(inside ? u : 0.0f), row = CONVERT_INTN(inside ? v : 0.0f);
        const floatn kept = GATHER_FLOATN(view.depths, row * view.width + col), depth = fabs(kept);
        const intn counts = (MASK(kept < 0.0f) & -has_unknown) | (MASK(kept > 0.0f) & MASK(r < near_m));
        const intn hidden = inside & counts & MASK(y.z - depth > bias_m);
        if (ANY(hidden)) {
            const floatn center_x = (CONVERT_FLOATN(col) - lens.s2) * per_x, center_y = (CONVERT_FLOATN(row) - lens.s3) * per_y;
            const floatn height = (center_x * normal.x + center_y * normal.y + normal.z) * depth - plane;
            const floatn sz = fmin(depth + slack * r, y.z), scale = sz * inverse;
            const floatn tx = y.x * scale - origin.x, ty = y.y * scale - origin.y, tz = sz - origin.z;
            const floatn along = tx * w.x + ty * w.y + tz * w.z, square = tx * tx + ty * ty + tz * tz;
            const floatn apart = 1.0f - along / sqrt(fmax(square, 1e-12f));
            free = (hidden & MASK(height > 0.0f)) ? fmin(free, fmax(apart * inverse_threshold, 0.0f)) : free;
        }
        r *= ratio;
    }
    return free;
}

// Reduces open[] of directions above the horizon by the occluders in the camera's own picture.
static void look_near(const View view, const float3 origin, const float3 surface, const float3 normal, const int count,
                      global const float4 *directions, global const float *starts, const float ratio, const int steps,
                      const int has_unknown, const float near_m, const float ray_length_m, const float bias_m, const float lift_m, const float slack,
                      const float inverse_threshold,
                      float *open) {
    const float3 origin_in_view = transform_point(view.view_from_volume, origin);
    const float3 surface_in_view = transform_point(view.view_from_volume, surface);
    const float3 normal_in_view = transform_vector(view.view_from_volume, normal);
    global const float *components = (global const float *)directions;
    int chosen[LANES];
    int waiting = 0;
    for (int j = 0; j < count; j++) {
        if (open[j] > 0.0f) chosen[waiting++] = j;
        if (waiting == 0 || (waiting < LANES && j < count - 1)) continue;
        for (int lane = waiting; lane < LANES; lane++) chosen[lane] = chosen[0];
        const intn which = LOAD_LANES(chosen), first = 4 * which;
        const Vectors w = {GATHER_FLOATN(components, first), GATHER_FLOATN(components, first + 1), GATHER_FLOATN(components, first + 2)};
        float found[LANES];
        STORE_LANES(visibility(view, origin_in_view, surface_in_view, normal_in_view, turned(view.view_from_volume, w),
                               GATHER_FLOATN(starts, which), ratio, steps, has_unknown, near_m, ray_length_m, bias_m, lift_m, slack, inverse_threshold),
                    found);
        for (int lane = 0; lane < waiting; lane++) open[chosen[lane]] = fmin(open[chosen[lane]], found[lane]);
        waiting = 0;
    }
}

// Mean normals around samples: see smooth_normal.clh -> [rows][cols], w: flatness, 0 where there is no surface. With HAS_CACHE also
// 0 where a sample is `found` (transfer_cache.cl): nothing is looked up for it.
kernel void smooth_normals(const int cols, const int rows, const int stride, const int width, const int height, const int radius,
                           global const float4 *positions, global const float4 *normals, const float voxel_m,
                           global float4 *sample_normals
#ifdef HAS_CACHE
                           , global const int *found
#endif
) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int x = stride / 2 + col * stride, y = stride / 2 + row * stride;
    int valid = positions[y * width + x].w > 0.0f && normals[y * width + x].w > 0.0f;
#ifdef HAS_CACHE
    valid = valid && found[row * cols + col] < 0;
#endif
    sample_normals[row * cols + col] = valid ? smooth_normal(width, height, positions, normals, x, y, radius, voxel_m) : (float4)(0.0f);
}

// T(x) = 1/pi * integral of V' max(n.w, 0) Y(w) dw, with V' from the camera's own depth and auxiliary views (6.2.1, 7.3.2).
// The unoccluded part is exact, as in radiance_transfer.cl, whose arguments and results the first and last ones are.
//
// sample_normals: see smooth_normals. lit [rows][cols][MASK_WORDS]: of look_into_views. camera_depths [height][width],
// camera_from_volume, intrinsics: the camera's picture, looked into at `steps` distances, which lie within near_m, and, unless it is 0,
// at `further` ones where there is something that the volume does not know. starts [4][count]: distance of a direction's first sample in metres,
// for the 2 x 2 pattern of jitter. inverse_threshold: 1 / chi. With HAS_CACHE samples that are `found` (transfer_cache.cl) keep their
// values.
kernel void transfer_from_views(const ViewTransferParameters parameters, global const float4 *positions,
                                global const float4 *sample_normals, global const uint *lit, global const float *camera_depths,
                                global const float4 *directions, global const float *basis, global const float *starts,
                                global const int *any_unknown, global float *transfer, global float *openness,
                                global float *flatness, global uint *free_mask, global uchar *sets
#ifdef HAS_CACHE
                                , global const int *found
#endif
) {
    const Grid grid = parameters.grid;
    const int count = parameters.count;
    const float voxel_m = parameters.voxel_m;
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col;
#ifdef HAS_CACHE
    if (found[sample] >= 0) return;
#endif
    const float4 position = positions[sample_pixel(grid, row, col)];
    const float4 normal = sample_normals[sample];
    const int valid = normal.w > 0.0f;
    const int own = parameters.first_set + direction_set(row, col);

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
        const int set = own * count;
        float open[DIRECTIONS];
        for (int j = 0; j < count; j++) open[j] = (lit[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1;
        const int has_unknown = parameters.further > 0 && *any_unknown;
        const View camera = {parameters.camera_from_volume, parameters.intrinsics, grid.width, parameters.height, camera_depths};
        look_near(camera, position.xyz + voxel_m * normal.xyz, position.xyz, normal.xyz, count, directions + set,
                  starts + ((row & 1) * 2 + (col & 1)) * count, parameters.ratio, has_unknown ? parameters.further : parameters.steps,
                  has_unknown, parameters.near_m, parameters.ray_length_m, voxel_m, voxel_m, parameters.slack, parameters.inverse_threshold, open);
        for (int j = 0; j < count; j++) {
            const float4 direction = directions[set + j];
            const float share = fmax(dot(normal.xyz, direction.xyz), 0.0f) * direction.w * M_1_PI_F;
            const float blocked = share * (1.0f - open[j]);
            sky += share;
            blocked_sky += blocked;
            if (open[j] >= FREE_BIT) mask[j >> 5] |= 1u << (j & 31);
            if (blocked == 0.0f) continue;
            global const float *y = basis + (set + j) * COEFFICIENTS;
            for (int i = 0; i < COEFFICIENTS; i++) t[i] -= blocked * y[i];
        }
    }
    for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = t[i];
    for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = mask[i];
    sets[sample] = (uchar)own;
    flatness[sample] = normal.w;
    openness[sample] = valid && sky > 0.0f ? 1.0f - blocked_sky / sky : -1.0f;
}
