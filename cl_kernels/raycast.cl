// Surface prediction (KinectFusion; thesis 4.2.1): the zero crossing of the TSDF along each pixel's ray, and its normal.
// Provides raycast.
#include "camera.clh"
#include "volume.clh"

// Gradient by central differences one voxel wide, trilinear between voxels; (0, 0, 0) where a neighbour was never seen.
static float3 wide_gradient(const Volume volume, const float3 point) {
    float3 f;
    const int3 base = trilinear_cell(volume, point, &f);
    float3 sum = (float3)(0.0f);
    float least_weight = 1.0f;
    for (int corner = 0; corner < 8; corner++) {
        const int3 o = (int3)(corner & 1, (corner >> 1) & 1, corner >> 2);
        const int3 v = base + o;
        const float2 xl = load_voxel(volume, v - (int3)(1, 0, 0)), xh = load_voxel(volume, v + (int3)(1, 0, 0));
        const float2 yl = load_voxel(volume, v - (int3)(0, 1, 0)), yh = load_voxel(volume, v + (int3)(0, 1, 0));
        const float2 zl = load_voxel(volume, v - (int3)(0, 0, 1)), zh = load_voxel(volume, v + (int3)(0, 0, 1));
        const float w = (o.x ? f.x : 1.0f - f.x) * (o.y ? f.y : 1.0f - f.y) * (o.z ? f.z : 1.0f - f.z);
        sum += w * (float3)(xh.x - xl.x, yh.x - yl.x, zh.x - zl.x);
        least_weight = fmin(least_weight, fmin(fmin(fmin(xl.y, xh.y), fmin(yl.y, yh.y)), fmin(zl.y, zh.y)));
    }
    return least_weight > 0.0f ? sum : (float3)(0.0f);
}

// Gradient of the trilinear cell alone: needs only the eight voxels that the zero crossing needed.
static float3 cell_gradient(const Volume volume, const float3 point) {
    float3 f;
    const int3 base = trilinear_cell(volume, point, &f);
    float3 sum = (float3)(0.0f);
    for (int corner = 0; corner < 8; corner++) {
        const int3 o = (int3)(corner & 1, (corner >> 1) & 1, corner >> 2);
        const float value = load_voxel(volume, base + o).x;
        const float3 w = (float3)(o.x ? f.x : 1.0f - f.x, o.y ? f.y : 1.0f - f.y, o.z ? f.z : 1.0f - f.z);
        sum += value * (float3)((o.x ? 1.0f : -1.0f) * w.y * w.z, (o.y ? 1.0f : -1.0f) * w.x * w.z,
                                (o.z ? 1.0f : -1.0f) * w.x * w.y);
    }
    return sum;
}

// Distance along the ray at which it enters the surface from the front, 0 if it does not.
static float find_surface(const Volume volume, const float3 origin, const float3 direction, const float3 inverse,
                          float t, const float end) {
    const float brick_m = BRICK * volume.voxel_m;
    float front = -1.0f;  // where the ray was last seen in front of a surface
    while (t < end) {
        const float3 p = origin + t * direction;
        const int3 voxel = convert_int3(p / volume.voxel_m);
        const int3 brick = min(max(voxel >> 3, (int3)(0)), volume.bricks.xyz - 1);
        const int index = brick_index(volume.bricks, brick);
        const int gap = volume.gaps[index];
        if (gap > 0) {
            t += fmax(empty_span(p, inverse, brick, gap, brick_m), 0.0f) + 0.01f * volume.voxel_m;
            front = -1.0f;
            continue;
        }
        const float2 here = volume.voxels[volume.slots[index] * BRICK_VOXELS + voxel_in_brick(voxel)];
        if (here.y == 0.0f) {
            front = -1.0f;
            t += 0.5f * volume.voxel_m;
        } else if (here.x > 0.0f) {
            front = t;
            t += fmax(0.7f * here.x * volume.truncation_m, 0.5f * volume.voxel_m);
        } else {
            if (front >= 0.0f) {
                int valid_front, valid_back;
                const float a = sample_tsdf(volume, origin + front * direction, &valid_front);
                const float b = sample_tsdf(volume, p, &valid_back);
                if (valid_front && valid_back && a > 0.0f && b <= 0.0f) {
                    const float guess = front + (t - front) * a / (a - b);
                    int valid;
                    const float c = sample_tsdf(volume, origin + guess * direction, &valid);
                    const float refined = c > 0.0f ? guess + (t - guess) * c / (c - b) : front + (guess - front) * a / (a - c);
                    return valid ? refined : guess;
                }
            }
            if (t - front > volume.truncation_m) front = -1.0f;
            t += 0.5f * volume.voxel_m;
        }
    }
    return 0.0f;
}

// -> positions [h][w] (volume space metres, w = 1 surface, 0 none), normals [h][w] (unit, towards free space, w likewise).
kernel void raycast(const int width, const int height, const int4 bricks, global const int *slots, global const uchar *gaps,
                    global const float2 *voxels, const float voxel_m, const float truncation_m, const float4 intrinsics,
                    const float16 volume_from_camera, const float greatest_depth_m,
                    global float4 *positions, global float4 *normals) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Volume volume = make_volume(bricks, voxel_m, truncation_m, slots, gaps, voxels);
    const float3 origin = volume_from_camera.s37b;
    const float3 ray = transform_vector(volume_from_camera, unproject(intrinsics, x, y));
    const float along = length(ray);
    const float3 direction = ray / along;
    const float3 inverse = safe_inverse(direction);
    const float2 span = clip_to_volume(volume, origin, inverse);
    const float end = fmin(span.y, greatest_depth_m * along) - 0.01f * voxel_m;
    const float t = find_surface(volume, origin, direction, inverse, fmax(span.x, 0.0f) + 0.01f * voxel_m, end);

    float4 position = (float4)(0.0f);
    float4 normal = (float4)(0.0f);
    if (t > 0.0f) {
        const float3 p = origin + t * direction;
        float3 gradient = wide_gradient(volume, p);
        if (dot(gradient, gradient) < 1e-12f) gradient = cell_gradient(volume, p);
        const float steepness = length(gradient);
        if (steepness > 1e-6f && dot(gradient, direction) < 0.0f) {
            position = (float4)(p, 1.0f);
            normal = (float4)(gradient / steepness, 1.0f);
        }
    }
    positions[y * width + x] = position;
    normals[y * width + x] = normal;
}
