// TSDF integration (KinectFusion; thesis 4.2.1): a weighted running mean of projective signed distances.
// Provides integrate.
#include "camera.clh"
#include "volume.clh"

// Measured depth at `pixel` (coordinates + 0.5, inside the picture), 0 = none: bilinear where the four pixels around it are
// one surface, whose slope would else become noise of the normals; of the nearest pixel where they are `edge_m` apart.
static float depth_at(const int width, const int height, global const float *depth_m, const float2 pixel, const float edge_m) {
    const int x = clamp((int)(pixel.x + 0.5f) - 1, 0, width - 2);
    const int y = clamp((int)(pixel.y + 0.5f) - 1, 0, height - 2);
    global const float *corner = depth_m + y * width + x;
    const float4 d = (float4)(corner[0], corner[1], corner[width], corner[width + 1]);
    const float low = fmin(fmin(d.x, d.y), fmin(d.z, d.w)), high = fmax(fmax(d.x, d.y), fmax(d.z, d.w));
    if (low <= 0.0f || high - low >= edge_m) return depth_m[(int)pixel.y * width + (int)pixel.x];
    const float u = clamp(pixel.x - 0.5f - x, 0.0f, 1.0f);
    return mix(mix(d.x, d.y, u), mix(d.z, d.w, u), clamp(pixel.y - 0.5f - y, 0.0f, 1.0f));
}

// One work-group of 8 x 8 items a brick, each item a column of 8 voxels along z.
// allocated [count] brick indices, slots [z][y][x], depth_m [h][w] (0 = none) -> voxels, updated in place.
kernel void integrate(const int count, const int width, const int height, const int4 bricks,
                      global const int *allocated, global const int *slots, global const float *depth_m,
                      const float4 intrinsics, const float16 camera_from_volume, const float voxel_m,
                      const float truncation_m, const float greatest_weight, global float2 *voxels) {
    const int group = get_group_id(0);
    if (group >= count) return;
    const int index = allocated[group];
    const int3 brick = (int3)(index % bricks.x, (index / bricks.x) % bricks.y, index / (bricks.x * bricks.y));
    const float3 center = transform_point(camera_from_volume, (convert_float3(brick) + 0.5f) * (BRICK * voxel_m));
    const float radius = 0.8661f * BRICK * voxel_m;  // half the brick's diagonal
    if (center.z < -radius) return;
    const float margin_x = (fabs(center.x) - radius) * intrinsics.s0;
    const float margin_y = (fabs(center.y) - radius) * intrinsics.s1;
    const float reach = center.z + radius;
    const float side_x = fmax(intrinsics.s2, width - intrinsics.s2) + 0.5f;  // farthest pixel from the axis
    const float side_y = fmax(intrinsics.s3, height - intrinsics.s3) + 0.5f;
    if (margin_x > reach * side_x || margin_y > reach * side_y) return;

    const int3 first = brick * BRICK + (int3)(get_local_id(0), get_local_id(1), 0);
    global float2 *column = voxels + slots[index] * BRICK_VOXELS + get_local_id(1) * BRICK + get_local_id(0);
    const float3 start = transform_point(camera_from_volume, (convert_float3(first) + 0.5f) * voxel_m);
    const float3 step = voxel_m * camera_from_volume.s26a;
    for (int i = 0; i < BRICK; i++) {
        const float3 p = start + (float)i * step;
        const float2 pixel = project(intrinsics, (float3)(p.x, p.y, fmax(p.z, 1e-6f))) + 0.5f;
        const int seen = p.z > 0.0f && pixel.x >= 0.0f && pixel.y >= 0.0f && pixel.x < width && pixel.y < height;
        const float slant = length(p) / fmax(p.z, 1e-6f);
        float depth = seen ? depth_m[(int)pixel.y * width + (int)pixel.x] : 0.0f;
        // Neighbours differ by less than a truncation, or are not used: farther off, the nearest pixel decides as well.
        const int close = depth > 0.0f && fabs(depth - p.z) * slant < truncation_m * (1.0f + slant);
        if (close) depth = depth_at(width, height, depth_m, pixel, truncation_m);
        const float distance = (depth - p.z) * slant;
        if (depth > 0.0f && distance > -truncation_m) {
            const float2 old = column[i * BRICK * BRICK];
            const float tsdf = fmin(distance / truncation_m, 1.0f);
            const float weight = old.y + 1.0f;
            column[i * BRICK * BRICK] = (float2)(old.x + (tsdf - old.x) / weight, fmin(weight, greatest_weight));
        }
    }
}
