// Surface prediction (KinectFusion; thesis 4.2.1): the zero crossing of the TSDF along each pixel's ray, and its normal.
// Provides raycast.
#include "camera.clh"
#include "volume.clh"

// Gradient of the tsdf from the 4x4x4 voxels around a point in voxels; (0, 0, 0) where there is none.
// Where all of them were seen: central differences one voxel wide, trilinear between voxels. Else of the inner cell alone.
static float3 surface_gradient(const Volume volume, const float3 point) {
    float3 f;
    const int3 low = trilinear_cell(point, &f) - 1;
    int starts[8];
    brick_starts(volume, low, low + 3, starts);
    const float tx[4] = {0.0f, 1.0f - f.x, f.x, 0.0f}, dx[4] = {f.x - 1.0f, -f.x, 1.0f - f.x, f.x};
    const float ty[4] = {0.0f, 1.0f - f.y, f.y, 0.0f}, dy[4] = {f.y - 1.0f, -f.y, 1.0f - f.y, f.y};
    const float tz[4] = {0.0f, 1.0f - f.z, f.z, 0.0f}, dz[4] = {f.z - 1.0f, -f.z, 1.0f - f.z, f.z};
    const float c[4] = {0.0f, -1.0f, 1.0f, 0.0f};
    float3 wide = (float3)(0.0f);
    float3 cell = (float3)(0.0f);
    float least_weight = 1.0f;
#pragma unroll
    for (int k = 0; k < 4; k++) {
#pragma unroll
        for (int j = 0; j < 4; j++) {
#pragma unroll
            for (int i = 0; i < 4; i++) {
                const int outer = (i == 0 || i == 3) + (j == 0 || j == 3) + (k == 0 || k == 3);
                if (outer > 1) continue;
                const float2 v = load_from(volume, starts, low, low.x + i, low.y + j, low.z + k);
                wide += v.x * (float3)(dx[i] * ty[j] * tz[k], tx[i] * dy[j] * tz[k], tx[i] * ty[j] * dz[k]);
                cell += v.x * (float3)(c[i] * ty[j] * tz[k], tx[i] * c[j] * tz[k], tx[i] * ty[j] * c[k]);
                least_weight = v.y < least_weight ? v.y : least_weight;
            }
        }
    }
    return least_weight > 0.0f ? wide : cell;
}

// From a point within about a voxel of the surface: one Newton and one secant step along the ray in the trilinear field.
// 0 where the field was not seen or does not fall through zero there.
static float refine_crossing(const Volume volume, const VoxelRay ray, const float start) {
    const float truncation = volume.truncation_m / volume.voxel_m;
    int seen_a, seen_b;
    const float a = sample_tsdf(volume, ray.origin + start * ray.direction, &seen_a);
    const float step = (a > 0.0f ? fmax(a * truncation, 0.25f) : fmin(a * truncation, -0.25f));
    const float b = sample_tsdf(volume, ray.origin + (start + step) * ray.direction, &seen_b);
    const float slope = (b - a) / step;  // per voxel, negative where the ray enters
    if (!seen_a || !seen_b || slope > -0.05f / truncation) return 0.0f;
    const float onward = -b / slope;
    return fabs(onward) < 1.5f ? start + step + onward : 0.0f;
}

// Distance in voxels along the ray at which it enters the surface from the front, 0 if it does not.
static float find_surface(const Volume volume, const VoxelRay ray, const float begin, const float end) {
    float t = begin;
    while (t < end) {
        const Crossing cell = next_solid_cell(volume, ray, t, end);
        if (cell.octet == 0) return 0.0f;
        const float solid = first_solid(ray, cell);
        if (solid >= 0.0f) {
            const float crossing = refine_crossing(volume, ray, solid - 0.4f);
            if (crossing > begin) return crossing;
        }
        t = cell.leave + 0.01f;
    }
    return 0.0f;
}

// The first surface along the ray that faces it, as distance in voxels, 0 if there is none; beside a silhouette the ray may
// cross the field where it slopes away, and goes on to what lies behind. -> normal: unit, towards free space.
static float find_facing_surface(const Volume volume, const VoxelRay ray, const float begin, const float end, float3 *normal) {
    for (float t = find_surface(volume, ray, begin, end); t > 0.0f; t = find_surface(volume, ray, t + 0.5f, end)) {
        const float3 gradient = surface_gradient(volume, ray.origin + t * ray.direction);
        const float steepness = length(gradient);
        if (steepness > 1e-6f && dot(gradient, ray.direction) < 0.0f) {
            *normal = gradient / steepness;
            return t;
        }
    }
    return 0.0f;
}

// Volume and view -> positions [h][w] (volume space metres, w = 1 surface, 0 none), normals [h][w] (unit, towards free space, w likewise).
kernel void raycast(const int width, const int height, const int4 bricks, global const int *slots, global const uchar *gaps,
                    global const ulong *solid, global const uchar *octets, global const float2 *voxels, const float voxel_m, const float truncation_m, const float4 intrinsics,
                    const float16 volume_from_camera, const float greatest_depth_m,
                    global float4 *positions, global float4 *normals) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Volume volume = make_volume(bricks, voxel_m, truncation_m, slots, gaps, solid, octets, voxels);
    const float3 ray_m = transform_vector(volume_from_camera, unproject(intrinsics, x, y));
    const float along = length(ray_m);
    const VoxelRay ray = make_voxel_ray(volume, volume_from_camera.s37b, ray_m / along);
    const float2 span = clip_to_volume(volume, ray);
    float3 facing = (float3)(0.0f);
    const float t = find_facing_surface(volume, ray, span.x, fmin(span.y, greatest_depth_m * along / voxel_m), &facing);
    const float hit = t > 0.0f ? 1.0f : 0.0f;
    positions[y * width + x] = (float4)(hit * voxel_m * (ray.origin + t * ray.direction), hit);
    normals[y * width + x] = (float4)(facing, hit);
}
