// Hybrid geometry buffer (thesis 4.2.2, eq. 4.3): the volume where it agrees with the sensor, the sensor where it does not.
// Provides merge_depth.
#include "camera.clh"

#define LABEL_NONE 0
#define LABEL_STATIC 1
#define LABEL_DYNAMIC 2

// Depth and ray of a neighbour as a point in camera space; w = 0 where it has no depth or lies across an edge.
static inline float4 neighbour(const int width, const int height, global const float *depth_m, const float4 intrinsics,
                               const int x, const int y, const float depth) {
    if (x < 0 || y < 0 || x >= width || y >= height) return (float4)(0.0f);
    const float z = depth_m[y * width + x];
    const float edge = fmax(0.02f, 6.0f / intrinsics.s0) * depth + 0.005f;  // two pixels of a surface seen at up to 70 degrees
    return z > 0.0f && fabs(z - depth) < edge ? (float4)(z * unproject(intrinsics, x, y), 1.0f) : (float4)(0.0f);
}

// Normal of the measured depth by differences to the neighbours that lie on the same surface, towards the camera; w = 0 if none.
static float4 measured_normal(const int width, const int height, global const float *depth_m, const float4 intrinsics,
                              const int x, const int y, const float3 here) {
    const float4 left = neighbour(width, height, depth_m, intrinsics, x - 2, y, here.z);
    const float4 right = neighbour(width, height, depth_m, intrinsics, x + 2, y, here.z);
    const float4 up = neighbour(width, height, depth_m, intrinsics, x, y - 2, here.z);
    const float4 down = neighbour(width, height, depth_m, intrinsics, x, y + 2, here.z);
    const float3 along_x = (right.w > 0.0f ? right.xyz : here) - (left.w > 0.0f ? left.xyz : here);
    const float3 along_y = (down.w > 0.0f ? down.xyz : here) - (up.w > 0.0f ? up.xyz : here);
    const float3 n = cross(along_y, along_x);
    const float size = length(n);
    return size > 1e-12f ? (float4)(n / size, 1.0f) : (float4)(0.0f);
}

// Sensor noise of structured light and stereo along z (Nguyen et al. 2012, eq. 3), metres.
static inline float depth_sigma(const float z) {
    return 0.0012f + 0.0019f * (z - 0.4f) * (z - 0.4f);
}

// model_positions, model_normals [h][w]: the volume's surface; depth_m [h][w] measured, 0 = none.
// -> positions, normals [h][w]: the merged geometry buffer; labels [h][w]: none, static (from the volume), dynamic (from the sensor: the volume says otherwise or nothing).
kernel void merge_depth(const int width, const int height, global const float *depth_m, const float4 intrinsics,
                        const float16 volume_from_camera, const float16 camera_from_volume, const float voxel_m,
                        global const float4 *model_positions, global const float4 *model_normals,
                        global float4 *positions, global float4 *normals, global uchar *labels) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const float measured = depth_m[pixel];
    const float4 surface = model_positions[pixel];
    const float predicted = transform_point(camera_from_volume, surface.xyz).z;
    const float agree = 1.5f * voxel_m + 4.0f * depth_sigma(measured);  // lambda_D
    if (surface.w > 0.0f && (measured <= 0.0f || fabs(measured - predicted) < agree)) {
        positions[pixel] = surface;
        normals[pixel] = model_normals[pixel];
        labels[pixel] = LABEL_STATIC;
    } else if (measured > 0.0f) {
        const float3 point = measured * unproject(intrinsics, x, y);
        const float4 normal = measured_normal(width, height, depth_m, intrinsics, x, y, point);
        positions[pixel] = (float4)(transform_point(volume_from_camera, point), 1.0f);
        normals[pixel] = (float4)(transform_vector(volume_from_camera, normal.xyz), normal.w);
        labels[pixel] = LABEL_DYNAMIC;
    } else {
        positions[pixel] = (float4)(0.0f);
        normals[pixel] = (float4)(0.0f);
        labels[pixel] = LABEL_NONE;
    }
}
