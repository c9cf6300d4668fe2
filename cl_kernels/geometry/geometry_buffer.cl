// The geometry buffer of the hybrid depth picture (thesis 4.2.2): positions, normals and labels.
// Provides geometry_buffer.
#include "agreement.clh"
#include "camera.clh"
#include "planes.clh"

#define LABEL_NONE 0
#define LABEL_STATIC 1
#define LABEL_DYNAMIC 2
#define LABEL_FILLED 3

// Slopes of eight planes: relative change of the inverse depth per pixel along x and y.
typedef struct {
    float8 x;
    float8 y;
    int8 valid;  // -1 where at least three pixels are on the same surface
} Slopes;

// A plane's inverse depth is linear in the pixel: least squares over 5 x 5 pixels, STEP apart, of the same surface. The ridge
// term makes the slope across a surface one pixel wide 0; in a whole window it reduces slopes by 1 %.
#define STEP 2
#define RIDGE 0.5f
static Slopes fit_slopes(global const float *depth, const int pitch, const int at, const float focal_px) {
    const float8 here = vload8(0, depth + at);
    const int8 known = here > 0.0f;
    // Depths of one surface differ by at most 5 mm plus 2 % or, if greater, a slope of 3 across half the window.
    const float8 near = fmax(0.02f, 6.0f * STEP / focal_px) * here + 0.005f;
    float8 n = 0.0f, sx = 0.0f, sy = 0.0f, sxx = 0.0f, sxy = 0.0f, syy = 0.0f, sr = 0.0f, sxr = 0.0f, syr = 0.0f;
#pragma unroll
    for (int i = 0; i < 25; i++) {
        const float dx = i % 5 - 2, dy = i / 5 - 2;
        const float8 there = vload8(0, depth + at + (i / 5 - 2) * STEP * pitch + (i % 5 - 2) * STEP);
        const int8 used = known & (there > 0.0f) & (fabs(there - here) < near);
        const float8 one = as_float8(used & as_int8((float8)(1.0f)));
        const float8 r = as_float8(used & as_int8(here / there - 1.0f));
        n += one;
        sx += dx * one;
        sy += dy * one;
        sxx += dx * dx * one;
        sxy += dx * dy * one;
        syy += dy * dy * one;
        sr += r;
        sxr += dx * r;
        syr += dy * r;
    }
    const float8 mean = 1.0f / select(n, (float8)(1.0f), n < 1.0f);
    const float8 xx = sxx - sx * sx * mean + RIDGE, xy = sxy - sx * sy * mean, yy = syy - sy * sy * mean + RIDGE;
    const float8 xr = sxr - sx * sr * mean, yr = syr - sy * sr * mean;
    const float8 scale = 1.0f / (STEP * (xx * yy - xy * xy));
    const Slopes result = {scale * (xr * yy - yr * xy), scale * (yr * xx - xr * xy), n > 2.5f};
    return result;
}

// What is known of the eight pixels from (x, y) on: planes (see merge.cl; sensed is negative where sensor and volume agree) and
// the volume's surface.
typedef struct {
    global const float *depth;
    global const float *sensed;
    global const float *predicted;
    global const float4 *positions;
    global const float4 *normals;
    float4 intrinsics;
    float16 volume_from_camera;
    float voxel_m;
} Inputs;

typedef struct {
    float4 position;
    float4 normal;
    uchar label;
} SurfacePoint;

// The volume's surface where the filtered depth agrees with it, else the point at the filtered depth, labelled by whether the sensor
// agrees, with normal 0. at, pixel: of (x, y) in the planes and in the picture.
static SurfacePoint surface_at(const Inputs inputs, const int x, const int y, const int at, const int pixel) {
    const float z = inputs.depth[at], volume = fabs(inputs.predicted[at]), sensor = fabs(inputs.sensed[at]);
    const float near = AGREEMENT_M(z, inputs.voxel_m);
    const int has_shifted = inputs.sensed[at] > 0.0f && fabs(sensor - volume) < near;  // by less than lambda_D, but everywhere around
    SurfacePoint point = {(float4)(0.0f), (float4)(0.0f), LABEL_NONE};
    if (z > 0.0f && volume > 0.0f && fabs(z - volume) < near && !has_shifted) {
        point.position = inputs.positions[pixel];
        point.normal = inputs.normals[pixel];
        point.label = LABEL_STATIC;
    } else if (z > 0.0f) {
        point.position = (float4)(transform_point(inputs.volume_from_camera, z * unproject(inputs.intrinsics, x, y)), 1.0f);
        point.label = sensor > 0.0f && fabs(z - sensor) < near ? LABEL_DYNAMIC : LABEL_FILLED;
    }
    return point;
}

// depth, sensed, predicted: planes; model_positions, model_normals [h][w]. One item eight pixels of a row
// -> positions, normals, labels [h][w] of surface_at; where they are not the volume's, normals fitted to the depth around, unit, towards
// the camera; w = 0 if unknown.
kernel void geometry_buffer(const int width, const int height, const int pitch, global const float *depth,
                            global const float *sensed, global const float *predicted, const float4 intrinsics,
                            const float16 volume_from_camera, const float voxel_m, global const float4 *model_positions,
                            global const float4 *model_normals, global float4 *positions, global float4 *normals,
                            global uchar *labels) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Inputs inputs = {depth, sensed, predicted, model_positions, model_normals, intrinsics, volume_from_camera, voxel_m};
    const int pixel = y * width + x, at = plane_index(pitch, x, y);
    const int count = min(8, width - x);
    int fitted = 0;  // a bit for each pixel whose normal is to be found
    for (int i = 0; i < count; i++) {
        const SurfacePoint point = surface_at(inputs, x + i, y, at + i, pixel + i);
        positions[pixel + i] = point.position;
        normals[pixel + i] = point.normal;
        labels[pixel + i] = point.label;
        fitted |= (point.label >= LABEL_DYNAMIC) << i;
    }
    if (!fitted) return;
    const Slopes slopes = fit_slopes(depth, pitch, at, intrinsics.s0);
    float a[8], b[8];
    int valid[8];
    vstore8(slopes.x, 0, a);
    vstore8(slopes.y, 0, b);
    vstore8(slopes.valid, 0, valid);
    for (int i = 0; i < count; i++) {
        if (!((fitted >> i) & 1) || !valid[i]) continue;
        const float across = a[i] * (x + i - intrinsics.s2) + b[i] * (y - intrinsics.s3);
        const float3 facing = normalize((float3)(-a[i] * intrinsics.s0, -b[i] * intrinsics.s1, across - 1.0f));
        normals[pixel + i] = (float4)(transform_vector(volume_from_camera, facing), 1.0f);
    }
}
