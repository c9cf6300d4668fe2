// The brick volume's table: which bricks the measured surface needs, where they are solid, and how far apart those are.
// Provides mark_bricks, find_solid, start_gaps, gap_along_axis.
#include "camera.clh"
#include "volume.clh"

// Beyond this a point is outside any volume, and its brick may not fit an int.
#define FAR_BRICKS 1e6f

static inline int floor_of(const float x) {
    const int truncated = (int)x;
    return truncated - (x < truncated);
}

// depth_m [h][w], 0 = none -> wanted [z][y][x] = 1 for every brick within `reach_m` of the measured surface along its ray.
kernel void mark_bricks(const int width, const int height, const int4 bricks, global const float *depth_m,
                        const float4 intrinsics, const float16 volume_from_camera, const float voxel_m, const float reach_m,
                        global uchar *wanted) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const float depth = depth_m[y * width + x];
    if (depth <= 0.0f) return;
    // Of 2 x 2 pixels at one depth, the first marks for all: its margin reaches over them.
    const int is_first = ((x | y) & 1) == 0;
    if (!is_first && fabs(depth_m[(y & ~1) * width + (x & ~1)] - depth) < voxel_m) return;
    const float brick_m = BRICK * voxel_m;
    const float3 ray = unproject(intrinsics, x, y);
    const float reach_z = reach_m / length(ray);
    const float3 onward = transform_vector(volume_from_camera, ray) / brick_m;
    const float3 first = volume_from_camera.s37b / brick_m + (depth - reach_z) * onward;
    const int steps = (int)(4.0f * reach_m / brick_m) + 1;  // at most half a brick apart
    const float3 step = 2.0f * reach_z / steps * onward;
    // Around each step: half of the way to the next one, and the voxels beside the ray that are these pixels'.
    const float pixel = depth / (fmin(intrinsics.s0, intrinsics.s1) * voxel_m);
    const float pad = clamp(2.0f + 2.0f * pixel, 3.0f, 6.0f) / BRICK;
    for (int i = 0; i <= steps; i++) {
        const float3 p = first + (float)i * step;
        if (fabs(p.x) + fabs(p.y) + fabs(p.z) > FAR_BRICKS) continue;
        const int3 low = (int3)(max(floor_of(p.x - pad), 0), max(floor_of(p.y - pad), 0), max(floor_of(p.z - pad), 0));
        const int3 high = (int3)(min(floor_of(p.x + pad), bricks.x - 1), min(floor_of(p.y + pad), bricks.y - 1),
                                 min(floor_of(p.z + pad), bricks.z - 1));
        for (int bz = low.z; bz <= high.z; bz++)
            for (int by = low.y; by <= high.y; by++)
                for (int bx = low.x; bx <= high.x; bx++) wanted[(bz * bricks.y + by) * bricks.x + bx] = 1;  // all write 1
    }
}

// allocated [count] brick indices -> solid [z][y][x]: bit (z 4 + y) 4 + x where a cell of 2x2x2 voxels holds a solid voxel;
// octets [slot][64]: which of the cell's voxels are. One work-group of 64 items a brick, one item a cell.
kernel void find_solid(const int count, global const int *allocated, global const int *slots, global const float2 *voxels,
                       global ulong *solid, global uchar *octets) {
    local uint halves[64];
    const int group = get_group_id(0);
    const int cell = get_local_id(0);
    const int index = group < count ? allocated[group] : allocated[0];
    const int first = ((cell >> 4) * 2 * BRICK + ((cell >> 2) & 3) * 2) * BRICK + (cell & 3) * 2;
    global const float2 *corner = voxels + slots[index] * BRICK_VOXELS + first;
    uint octet = 0;
    for (int i = 0; i < 8; i++) {
        const float2 voxel = corner[((i >> 2) * BRICK + ((i >> 1) & 1)) * BRICK + (i & 1)];
        octet |= (voxel.y > 0.0f && voxel.x < 0.0f) << i;
    }
    halves[cell] = (octet != 0) << (cell & 31);
    if (group < count) octets[slots[index] * 64 + cell] = (uchar)octet;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (cell == 0 && group < count) {
        uint low = 0, high = 0;
        for (int i = 0; i < 32; i++) {
            low |= halves[i];
            high |= halves[32 + i];
        }
        solid[index] = ((ulong)high << 32) | low;
    }
}

// solid [z][y][x] -> gap [z][y][x]: 0 where a brick holds a solid voxel, else `limit`.
kernel void start_gaps(const int count, global const ulong *solid, const int limit, global uchar *gap) {
    const int index = get_global_id(0);
    if (index >= count) return;
    gap[index] = solid[index] != 0 ? 0 : (uchar)limit;
}

// One axis of the one-sided Chebyshev distance: the least, over bricks `offset` ahead, of max(offset, their distance so far).
// inner [variants][z][y][x] -> gap [2 variants][z][y][x]: first looking towards lower indices, then towards higher ones.
kernel void gap_along_axis(const int4 bricks, const int variants, global const uchar *inner, const int axis, const int limit,
                           global uchar *gap) {
    const int variant = get_global_id(2) / bricks.z;
    const int3 b = (int3)(get_global_id(0), get_global_id(1), get_global_id(2) % bricks.z);
    if (!inside_bricks(bricks, b) || variant >= 2 * variants) return;
    const int volume = bricks.x * bricks.y * bricks.z;
    const int ahead = variant >= variants ? 1 : -1;
    const int position = axis == 0 ? b.x : axis == 1 ? b.y : b.z;
    const int size = axis == 0 ? bricks.x : axis == 1 ? bricks.y : bricks.z;
    const int stride = ahead * (axis == 0 ? 1 : axis == 1 ? bricks.x : bricks.x * bricks.y);
    const int room = ahead > 0 ? size - 1 - position : position;
    global const uchar *from = inner + (variant % variants) * volume + brick_index(bricks, b);
    int nearest = limit;
    for (int offset = 0; offset <= room && offset < nearest; offset++) {
        const int there = from[offset * stride];
        const int distance = there > offset ? there : offset;
        nearest = distance < nearest ? distance : nearest;
    }
    gap[variant * volume + brick_index(bricks, b)] = (uchar)nearest;
}
