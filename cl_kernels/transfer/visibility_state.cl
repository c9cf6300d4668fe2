// The visibility state of voxels (thesis 6.1.2): set from traced samples, cleared where the reconstruction changed.
// Provides mark_samples, compare_views, clear_bricks.
#include "camera.clh"
#include "visibility_state.clh"

#define LABEL_STATIC 1

// One item a sample of the transfer. value 1: sets the bits of the voxels that hold an open sample of static surface;
// value 0, launched afterwards: clears the bits of voxels that hold a sample that is not open, so that the order does not matter.
// openness [rows][cols], positions, labels [h][w] -> state [voxels / 32].
kernel void mark_samples(const int cols, const int rows, const int stride, const int width, global const float4 *positions,
                         global const uchar *labels, global const float *openness, const float least_openness, const int4 bricks,
                         const float voxel_m, const int value, global uint *state) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float free = openness[row * cols + col];
    if (free < 0.0f) return;
    const int open = free >= least_openness && labels[pixel] == LABEL_STATIC;
    if (open != value) return;
    const uint bit = state_bit(bricks, voxel_m, positions[pixel].xyz);
    if (value)
        atomic_or(state + (bit >> 5), 1u << (bit & 31));
    else
        atomic_and(state + (bit >> 5), ~(1u << (bit & 31)));
}

// Whether no pixel of 3 x 3 around (x, y) has about this depth: a shift of an edge by a pixel is no change.
static int is_gone(const int width, const int height, global const float4 *positions, const float16 camera_from_volume,
                   const int x, const int y, const float depth_m, const float tolerance_m) {
    int gone = 1;
    for (int v = max(y - 1, 0); v <= min(y + 1, height - 1); v++) {
        for (int u = max(x - 1, 0); u <= min(x + 1, width - 1); u++) {
            const float4 there = positions[v * width + u];
            if (there.w > 0.0f && fabs(transform_point(camera_from_volume, there.xyz).z - depth_m) < tolerance_m) gone = 0;
        }
    }
    return gone;
}

static inline void flag_brick(const int4 bricks, const float voxel_m, const float3 point, global uchar *changed) {
    const int3 brick = clamp(convert_int3(point / (BRICK * voxel_m)), (int3)(0), bricks.xyz - 1);
    changed[brick_index(bricks, brick)] = 1;
}

// Views of one validation camera, before and now [h][w] (volume metres, w = 1 where there is surface).
// -> changed [bricks]: set where surface disappeared or appeared; others are not written.
kernel void compare_views(const int width, const int height, global const float4 *before, global const float4 *after,
                          const float16 camera_from_volume, const float tolerance_m, const int4 bricks, const float voxel_m,
                          global uchar *changed) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const float4 old = before[y * width + x], new = after[y * width + x];
    const float old_m = transform_point(camera_from_volume, old.xyz).z, new_m = transform_point(camera_from_volume, new.xyz).z;
    if (old.w > 0.0f && is_gone(width, height, after, camera_from_volume, x, y, old_m, tolerance_m))
        flag_brick(bricks, voxel_m, old.xyz, changed);
    if (new.w > 0.0f && is_gone(width, height, before, camera_from_volume, x, y, new_m, tolerance_m))
        flag_brick(bricks, voxel_m, new.xyz, changed);
}

// One item a row of eight voxels: forgets all voxels of the bricks that `stale` [bricks] marks. state: a byte holds eight.
kernel void clear_bricks(const int4 bricks, global const uchar *stale, global uchar *state) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    const int z = get_global_id(2);
    if (x >= bricks.x || y >= BRICK * bricks.y || z >= BRICK * bricks.z) return;
    if (stale[brick_index(bricks, (int3)(x, y / BRICK, z / BRICK))]) state[(z * BRICK * bricks.y + y) * bricks.x + x] = 0;
}
