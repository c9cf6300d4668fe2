// Exposure of a picture relative to earlier ones: its brightness on surface whose colour the volume knows.
// Provides compare_exposure, scale_radiance.
#include "agreement.clh"
#include "camera.clh"
#include "radiance_marks.clh"
#include "volume.clh"
#include "voxel_color.clh"

#define LUMINANCE (float3)(0.2126f, 0.7152f, 0.0722f)
#define MOST_UNEVEN 0.25f    // of the mean: beside an edge, a small registration error shows another surface
#define LEAST_COSINE 0.3f    // of the angle between the ray and the surface's normal
#define MOST_PREDICTED 0.9f  // of the greatest colour a voxel can hold
#define LEAST_PREDICTED 0.002f
#define LEAST_COLORED 0.5f   // share of the interpolation weights with a colour

// The volume interpolated at a point: tsdf in truncations, its gradient, and the colour of the voxels that have one.
typedef struct {
    float tsdf;
    float3 slope;
    int seen;         // whether enough pictures have seen all eight voxels
    float luminance;
    float brightest;  // greatest channel of any voxel
    float observations; // mean number behind the colours
    float colored;    // share of the weights with a colour
} Around;

static Around interpolate_around(const int4 bricks, global const int *slots, global const float2 *voxels, global const uint *colors,
                          const float3 at, const float least_weight) {
    Around result = {0.0f, (float3)(0.0f), 1, 0.0f, 0.0f, 0.0f, 0.0f};
    const float3 cell = floor(at - 0.5f);
    const float3 far = at - 0.5f - cell, near = 1.0f - far;
    for (int i = 0; i < 8; i++) {
        const int3 corner = (int3)(i & 1, (i >> 1) & 1, i >> 2);
        const int3 voxel = convert_int3(cell) + corner;
        const int3 brick = voxel >> 3;
        const int slot = inside_bricks(bricks, brick) ? slots[brick_index(bricks, brick)] : NO_SLOT;
        if (slot <= AWAY_SLOT) {
            result.seen = 0;
            continue;
        }
        const int index = slot * BRICK_VOXELS + ((voxel.z & 7) * BRICK + (voxel.y & 7)) * BRICK + (voxel.x & 7);
        const float2 pair = voxels[index];
        const float4 color = unpack_color(colors[index]);
        const float3 share = (float3)(corner.x ? far.x : near.x, corner.y ? far.y : near.y, corner.z ? far.z : near.z);
        const float weight = share.x * share.y * share.z;
        const float colored = color.w > 1.0f ? weight : 0.0f;  // at 1, of another light
        result.seen = result.seen && pair.y >= least_weight;
        result.tsdf += weight * pair.x;
        result.slope += pair.x * (float3)(corner.x ? share.y * share.z : -share.y * share.z, corner.y ? share.x * share.z : -share.x * share.z,
                                          corner.z ? share.x * share.y : -share.x * share.y);
        result.luminance += colored * dot(color.xyz, LUMINANCE);
        result.brightest = fmax(result.brightest, fmax(color.x, fmax(color.y, color.z)));
        result.observations += colored * (color.w - 1.0f);
        result.colored += colored;
    }
    const float scale = result.colored > 0.0f ? 1.0f / result.colored : 0.0f;
    result.luminance *= scale;
    result.observations *= scale;
    return result;
}

// Mean luminance of the 3 x 3 pixels around a pixel; 0 where one is not usable, or they vary too much.
static inline float even_luminance(const int width, const int height, global const float4 *radiance, const int x, const int y) {
    if (x < 1 || y < 1 || x >= width - 1 || y >= height - 1) return 0.0f;
    float sum = 0.0f, least = 1e9f, most = 0.0f;
    int usable = 1;
    for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
            const float4 here = radiance[(y + dy) * width + x + dx];
            const float luminance = dot(here.xyz, LUMINANCE);
            usable = usable && here.w > 0.0f;
            sum += luminance;
            least = fmin(least, luminance);
            most = fmax(most, luminance);
        }
    }
    const float mean = sum / 9.0f;
    return usable && most - least <= MOST_UNEVEN * mean ? mean : 0.0f;
}

// One item a sample: the middle pixel of each block of stride x stride.
// radiance, depth_m [h][w] as measured; slots, voxels, colors: the volume before this picture is integrated
// -> samples [rows][cols]: luminance of the picture, luminance that the volume predicts, number of observations behind the prediction,
// 0; all 0 where the picture is clipped, black or uneven, or where the volume has no coloured surface that faces the camera.
kernel void compare_exposure(const int cols, const int rows, const int stride, const int width, const int height,
                             global const float4 *radiance, global const float *depth_m, const float4 intrinsics,
                             const float16 volume_from_camera, const int4 bricks, global const int *slots,
                             global const float2 *voxels, global const uint *colors, const float voxel_m,
                             const float truncation_m, const float least_weight, global float4 *samples) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int x = col * stride + stride / 2, y = row * stride + stride / 2;
    float4 sample = (float4)(0.0f);
    const float seen = even_luminance(width, height, radiance, x, y);
    const float z = seen > 0.0f ? depth_m[y * width + x] : 0.0f;
    if (z > 0.0f) {
        const float3 ray = unproject(intrinsics, x, y);
        const float3 direction = normalize(transform_vector(volume_from_camera, ray));
        const float3 point = transform_point(volume_from_camera, z * ray);
        const Around there = interpolate_around(bricks, slots, voxels, colors, point / voxel_m, least_weight);
        const float off_m = there.tsdf * truncation_m;
        const float steepness = fmax(length(there.slope), 1e-6f);
        const int faces = -dot(there.slope, direction) > LEAST_COSINE * steepness;
        if (there.seen && faces && fabs(off_m) < fmin(AGREEMENT_M(z, voxel_m), 0.9f * truncation_m)) {
            const float3 on_surface = point + off_m * direction;  // along a ray, the field falls by 1 per truncation
            const Around surface = interpolate_around(bricks, slots, voxels, colors, on_surface / voxel_m, least_weight);
            const int known = surface.seen && surface.colored >= LEAST_COLORED && surface.brightest < MOST_PREDICTED &&
                              surface.luminance > LEAST_PREDICTED;
            if (known) sample = (float4)(seen, surface.luminance, surface.observations, 0.0f);
        }
    }
    samples[row * cols + col] = sample;
}

// radiance [count] of a picture -> scene [count]: the same times `factor`, in the units of the session's first picture. Clipped
// pixels are marked AT_LEAST.
kernel void scale_radiance(const int count, const float factor, global const float4 *radiance, global float4 *scene) {
    const int pixel = get_global_id(0);
    if (pixel >= count) return;
    const float4 here = radiance[pixel];
    const int clipped = here.w == 0.0f && fmax(fmax(here.x, here.y), here.z) > 0.5f;  // else it is black
    scene[pixel] = (float4)(factor * here.xyz, clipped ? AT_LEAST : here.w);
}
