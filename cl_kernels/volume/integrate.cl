// TSDF integration (KinectFusion; thesis 4.2.1): weighted running means of projective signed distance and of colour.
// Provides integrate.
#include "camera.clh"
#include "groups.clh"
#include "lanes.clh"
#include "radiance_marks.clh"
#include "volume.clh"

#define MOST_COLOR_WEIGHT 62  // of a mean; 1 more is stored in 6 bits
#define COLOR_REACH 1.5f  // voxels from the surface: interpolation on the surface reads no colour farther away

// The measured picture.
typedef struct {
    int width;
    int height;
    global const float *depth_m;  // [h][w], 0 = none
    global const float *radiance; // [h][w] rgb linear, w: see radiance_marks.clh
    float4 intrinsics;
} Picture;

// Measured depth at pixel coordinates + 0.5, inside the picture: bilinear where the four pixels are one surface, because
// steps between pixels would become noise of the normals; `nearest` where they differ by `edge_m` or not all are known.
static inline floatn depth_between(const Picture picture, const floatn u, const floatn v, const floatn nearest, const float edge_m) {
    const intn x = clamp(CONVERT_INTN(u + 0.5f) - 1, 0, picture.width - 2);
    const intn y = clamp(CONVERT_INTN(v + 0.5f) - 1, 0, picture.height - 2);
    const intn corner = y * picture.width + x;
    const floatn a = GATHER_FLOATN(picture.depth_m, corner), b = GATHER_FLOATN(picture.depth_m, corner + 1);
    const floatn c = GATHER_FLOATN(picture.depth_m, corner + picture.width);
    const floatn d = GATHER_FLOATN(picture.depth_m, corner + picture.width + 1);
    const floatn low = fmin(fmin(a, b), fmin(c, d)), high = fmax(fmax(a, b), fmax(c, d));
    const floatn along = clamp(u - 0.5f - CONVERT_FLOATN(x), 0.0f, 1.0f), down = clamp(v - 0.5f - CONVERT_FLOATN(y), 0.0f, 1.0f);
    const floatn top = a + along * (b - a), bottom = c + along * (d - c);
    return (MASK(low > 0.0f) & MASK(high - low < edge_m)) ? top + down * (bottom - top) : nearest;
}

// Running mean of one channel, stored as sqrt(c) * most in integers: stochastic rounding, so that changes below one step are
// not lost. A colour that is a lower bound only raises the mean. `dice`: uniform in [0, 1).
static inline intn mean_channel(const intn code, const float most, const floatn color, const intn is_bound, const floatn rate,
                                const floatn dice) {
    const floatn root = CONVERT_FLOATN(code) * (1.0f / most);
    const floatn more = color - root * root;
    const floatn mean = root * root + rate * (is_bound ? fmax(more, 0.0f) : more);
    const floatn next = sqrt(fmax(mean, 0.0f)) * most;
    return CONVERT_INTN(fmin(next + dice, most));
}

// Colours of a row of voxels after one more observation, see bricks.py for the packing. One of weight 0 is of another light.
static inline intn mean_color(const Picture picture, const intn before, const intn pixel, const intn voxel, const int frame) {
    const floatn mark = GATHER_FLOATN(picture.radiance, 4 * pixel + 3);
    const intn is_bound = MASK(mark == AT_LEAST);
    const intn weight = max(before & 63, 1) - 1;
    const intn next_weight = min(weight + 1, MOST_COLOR_WEIGHT);
    const floatn rate = 1.0f / CONVERT_FLOATN(next_weight);
    const intn old = weight > 0 ? before : 0;
    uintn h = AS_UINTN(voxel) * 0x9E3779B1u + (uint)frame * 0x85EBCA77u;
    h = (h ^ (h >> 15)) * 0x2C1B3C6Du;
    h = (h ^ (h >> 12)) * 0x297A2D39u;
    h ^= h >> 15;
    const float unit = 1.0f / 1024.0f;
    const intn red = mean_channel((old >> 23) & 511, 511.0f, fmin(GATHER_FLOATN(picture.radiance, 4 * pixel), 1.0f), is_bound, rate,
                                  CONVERT_FLOATN(AS_INTN(h & 1023u)) * unit);
    const intn green = mean_channel((old >> 14) & 511, 511.0f, fmin(GATHER_FLOATN(picture.radiance, 4 * pixel + 1), 1.0f), is_bound, rate,
                                    CONVERT_FLOATN(AS_INTN((h >> 10) & 1023u)) * unit);
    const intn blue = mean_channel((old >> 6) & 255, 255.0f, fmin(GATHER_FLOATN(picture.radiance, 4 * pixel + 2), 1.0f), is_bound, rate,
                                   CONVERT_FLOATN(AS_INTN((h >> 20) & 1023u)) * unit);
    const intn next = (red << 23) | (green << 14) | (blue << 6) | (next_weight + 1);
    return MASK(mark > -1.0f) ? next : before;
}

// One work-group a brick; its items share the rows of LANES voxels along x.
// allocated [count] brick indices, slots [z][y][x], picture -> voxels and colors, updated in place, or colors alone unless
// `with_shape`; solid and octets (volume.clh) of the bricks in the view frustum.
kernel void integrate(const int count, const int width, const int height, const int4 bricks, global const int *allocated,
                      global const int *slots, global const float *depth_m, global const float *radiance,
                      const float4 intrinsics, const float16 camera_from_volume, const float voxel_m,
                      const float truncation_m, const float greatest_weight, const int frame, const int with_shape,
                      global float2 *voxels, global uint *colors, global ulong *solid, global uchar *octets) {
    local int rows[BRICK * BRICK];  // bit x: that voxel is solid
    local uint halves[2];           // of the brick's solid cells
    const int group = group_number();
    const int item = get_local_id(0), items = get_local_size(0);
    const int index = allocated[min(group, count - 1)];
    const int3 brick = (int3)(index % bricks.x, (index / bricks.x) % bricks.y, index / (bricks.x * bricks.y));
    const float3 center = transform_point(camera_from_volume, (convert_float3(brick) + 0.5f) * (BRICK * voxel_m));
    const float radius = 0.8661f * BRICK * voxel_m;  // half the brick's diagonal
    const int touched = group < count && may_be_seen(intrinsics, width, height, center, radius);
    const Picture picture = {width, height, depth_m, radiance, intrinsics};
    const int pool = slots[index] * BRICK_VOXELS;
    const float3 corner = transform_point(camera_from_volume, (convert_float3(brick * BRICK) + 0.5f) * voxel_m);
    const float3 step_x = voxel_m * camera_from_volume.s048, step_y = voxel_m * camera_from_volume.s159;
    const float3 step_z = voxel_m * camera_from_volume.s26a;
    for (int row = item; row < BRICK * BRICK; row += items) rows[row] = 0;
    if (item == 0) halves[0] = halves[1] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);

    const int runs = touched ? BRICK_VOXELS / LANES : 0;
    for (int run = item; run < runs; run += items) {
        const int first = run * LANES;
        const int row = first / BRICK;
        const float3 start = corner + (row & 7) * step_y + (row >> 3) * step_z;
        const floatn lane = (first & 7) + LANE_NUMBERS;
        const floatn x = start.x + lane * step_x.x, y = start.y + lane * step_x.y, z = start.z + lane * step_x.z;
        const floatn inverse_z = 1.0f / fmax(z, 1e-6f);
        const floatn u = intrinsics.s0 * x * inverse_z + (intrinsics.s2 + 0.5f);
        const floatn v = intrinsics.s1 * y * inverse_z + (intrinsics.s3 + 0.5f);
        const intn seen = MASK(z > 0.0f) & MASK(u >= 0.0f) & MASK(v >= 0.0f) & MASK(u < width) & MASK(v < height);
        const intn pixel = CONVERT_INTN(seen ? v : 0.0f) * width + CONVERT_INTN(seen ? u : 0.0f);
        const floatn nearest = seen ? GATHER_FLOATN(depth_m, pixel) : 0.0f;
        const floatn slant = sqrt(x * x + y * y + z * z) * inverse_z;
        // Interpolation uses neighbours within a truncation only: farther from the surface, the nearest pixel decides as well.
        const intn close = MASK(nearest > 0.0f) & MASK(fabs(nearest - z) * slant < truncation_m * (1.0f + slant));
        floatn depth = nearest;
        if (ANY(close)) depth = close ? depth_between(picture, seen ? u : 0.5f, seen ? v : 0.5f, nearest, truncation_m) : nearest;
        const floatn distance = (depth - z) * slant;
        const intn known = MASK(depth > 0.0f) & MASK(distance > -truncation_m);
        floatn tsdf, weight;
        load_pairs(voxels + pool + first, &tsdf, &weight);
        if (ANY(known)) {
            if (with_shape) {
                const floatn observed = fmin(distance / truncation_m, 1.0f);
                const floatn more = weight + 1.0f;
                tsdf = known ? tsdf + (observed - tsdf) / more : tsdf;
                weight = known ? fmin(more, greatest_weight) : weight;
                store_pairs(tsdf, weight, voxels + pool + first);
            }
            const intn colored = known & MASK(fabs(distance) < COLOR_REACH * voxel_m);
            if (ANY(colored)) {
                global int *packed = (global int *)colors + pool + first;
                const intn old = LOAD_LANES(packed);
                const int voxel = index * BRICK_VOXELS + first;  // not the slot, which depends on the budget
                const intn mean = mean_color(picture, old, pixel, voxel + CONVERT_INTN(LANE_NUMBERS), frame);
                STORE_LANES(colored ? mean : old, packed);
            }
        }
        const int solid_bits = bits_of(MASK(weight > 0.0f) & MASK(tsdf < 0.0f)) << (first & 7);
        if (solid_bits) atomic_or(&rows[row], solid_bits);
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    const int cells = touched ? BRICK_CELLS : 0;
    for (int cell = item; cell < cells; cell += items) {
        const int row = (cell >> 4) * 2 * BRICK + ((cell >> 2) & 3) * 2;
        const int shift = (cell & 3) * 2;
        const int octet = ((rows[row] >> shift) & 3) | ((rows[row + 1] >> shift) & 3) << 2 |
                          ((rows[row + BRICK] >> shift) & 3) << 4 | ((rows[row + BRICK + 1] >> shift) & 3) << 6;
        octets[slots[index] * BRICK_CELLS + cell] = (uchar)octet;
        if (octet) atomic_or(&halves[cell >> 5], 1u << (cell & 31));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (touched && item == 0) solid[index] = ((ulong)halves[1] << 32) | halves[0];
}
