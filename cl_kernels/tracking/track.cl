// Camera tracking (KinectFusion 3.5; thesis 4.2.1): point-to-plane equations of projectively associated pixels.
// Provides halve_depth, view_model, sum_equations. Eight pixels of a row are one float8: PoCL vectorises nothing else here.
#include "camera.clh"

// Depth [fine_height][fine_width] (0 = none) -> [height][width], sizes halved: the mean of those of four pixels whose depth
// is at most 1 + `edge` times that of the nearest one.
kernel void halve_depth(const int width, const int height, const int fine_width, global const float *depth_m,
                        const float edge, global float *halved_m) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    global const float *corner = depth_m + 2 * y * fine_width + 2 * x;
    const float4 four = (float4)(corner[0], corner[1], corner[fine_width], corner[fine_width + 1]);
    const float4 there = select((float4)(INFINITY), four, four > 0.0f);
    const float nearest = fmin(fmin(there.x, there.y), fmin(there.z, there.w));
    const float4 used = select((float4)(0.0f), (float4)(1.0f), there <= nearest * (1.0f + edge) && four > 0.0f);
    const float count = dot(used, (float4)(1.0f));
    halved_m[y * width + x] = count > 0.0f ? dot(used, four) / count : 0.0f;
}

// Every stride-th pixel of the predicted surface (positions, normals [..][model_width], volume space), in the axes of its
// camera -> view: planes [4][height][pitch] of depth (metres, 0 = none) and the normal's x, y, z; padding is 0.
kernel void view_model(const int width, const int height, const int pitch, const int stride, const int model_width,
                       global const float4 *positions, global const float4 *normals, const float16 camera_from_volume,
                       global float *view) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= pitch || y >= height) return;
    const int source = y * stride * model_width + min(x, width - 1) * stride;
    const float4 position = positions[source];
    const float there = x < width ? position.w : 0.0f;
    const float3 n = transform_vector(camera_from_volume, normals[source].xyz);
    const int at = y * pitch + x, plane = height * pitch;
    view[at] = there * (dot(camera_from_volume.s89a, position.xyz) + camera_from_volume.sb);
    view[plane + at] = there * n.x;
    view[2 * plane + at] = there * n.y;
    view[3 * plane + at] = there * n.z;
}

static inline float sum8(const float8 v) {
    const float4 four = v.lo + v.hi;
    const float2 two = four.lo + four.hi;
    return two.x + two.y;
}

// One work-item sums 8 x ROWS pixels of the model's view. Both pictures have `size`; T = model_from_current.
// Residual of a pixel: e = n.(T p - v) / noise_m, where v, n are the model's point and normal, and p is the measured point at
// the pixel onto which v projects. Its weight is Tukey's with this cut-off. Pairs farther apart than `gate_m` are rejected.
// -> sums [item][32]: 21 of w J J^T (upper triangle by rows, J = (Tp x n, n) / noise_m), 6 of w J e, then the sums of w e^2,
// w, w z, pairs measured, model pixels in view.
kernel void sum_equations(const int2 size, const int pitch, global const float *view, global const float *depth_m,
                          const float4 view_intrinsics, const float4 intrinsics, const float16 model_from_current,
                          const float16 current_from_model, const float noise_m, const float cutoff,
                          const float gate_m, global float *sums) {
    const int column = get_global_id(0);
    const int strip = get_global_id(1);
    if (8 * column >= pitch || strip * ROWS >= size.y) return;
    const float16 R = model_from_current, I = current_from_model;
    const int plane = size.y * pitch;
    const float precision = 1.0f / noise_m;
    const float8 lane = (float8)(0, 1, 2, 3, 4, 5, 6, 7);
    const float8 ray_x = (8.0f * column + lane - view_intrinsics.s2) / view_intrinsics.s0;
    float8 s[32];
#pragma unroll
    for (int k = 0; k < 32; k++) s[k] = (float8)(0.0f);

    const int end = min((strip + 1) * ROWS, size.y);
    for (int y = strip * ROWS; y < end; y++) {
        const int offset = y * pitch + 8 * column;
        const float8 z = vload8(0, view + offset);
        const float8 nx = vload8(0, view + plane + offset);
        const float8 ny = vload8(0, view + 2 * plane + offset);
        const float8 nz = vload8(0, view + 3 * plane + offset);
        const float8 vx = ray_x * z, vy = (y - view_intrinsics.s3) / view_intrinsics.s1 * z;

        const float8 qz = I.s8 * vx + I.s9 * vy + I.sa * z + I.sb;
        const float8 inverse = 1.0f / fmax(qz, 0.01f);
        const float8 u = (I.s0 * vx + I.s1 * vy + I.s2 * z + I.s3) * inverse * intrinsics.s0 + intrinsics.s2 + 0.5f;
        const float8 v = (I.s4 * vx + I.s5 * vy + I.s6 * z + I.s7) * inverse * intrinsics.s1 + intrinsics.s3 + 0.5f;
        const int8 in_view = z > 0.0f && qz > 0.01f && u >= 0.0f && v >= 0.0f && u < (float)size.x && v < (float)size.y;
        const int8 iu = convert_int8(select((float8)(0.0f), u, in_view));
        const int8 iv = convert_int8(select((float8)(0.0f), v, in_view));
        const int8 at = iv * size.x + iu;
        const float8 depth = (float8)(depth_m[at.s0], depth_m[at.s1], depth_m[at.s2], depth_m[at.s3],
                                      depth_m[at.s4], depth_m[at.s5], depth_m[at.s6], depth_m[at.s7]);
        const int8 measured = in_view && depth > 0.0f;

        const float8 px = (convert_float8(iu) - intrinsics.s2) / intrinsics.s0 * depth;
        const float8 py = (convert_float8(iv) - intrinsics.s3) / intrinsics.s1 * depth;
        const float8 x3 = R.s0 * px + R.s1 * py + R.s2 * depth + R.s3;
        const float8 y3 = R.s4 * px + R.s5 * py + R.s6 * depth + R.s7;
        const float8 z3 = R.s8 * px + R.s9 * py + R.sa * depth + R.sb;
        const float8 dx = x3 - vx, dy = y3 - vy, dz = z3 - z;
        const float8 e = (nx * dx + ny * dy + nz * dz) * precision;
        const float8 u2 = e * e / (cutoff * cutoff);
        const int8 paired = measured && u2 < 1.0f && dx * dx + dy * dy + dz * dz < gate_m * gate_m;
        const float8 w = select((float8)(0.0f), (1.0f - u2) * (1.0f - u2), paired);

        const float8 J[6] = {(y3 * nz - z3 * ny) * precision, (z3 * nx - x3 * nz) * precision, (x3 * ny - y3 * nx) * precision,
                             nx * precision, ny * precision, nz * precision};
        int k = 0;
#pragma unroll
        for (int i = 0; i < 6; i++) {
            const float8 wJ = w * J[i];
#pragma unroll
            for (int j = i; j < 6; j++) s[k++] += wJ * J[j];
            s[21 + i] += wJ * e;
        }
        s[27] += w * e * e;
        s[28] += w;
        s[29] += w * z;
        s[30] -= convert_float8(measured);
        s[31] -= convert_float8(in_view);
    }
    global float *own = sums + 32 * (strip * (pitch / 8) + column);
#pragma unroll
    for (int k = 0; k < 32; k++) own[k] = sum8(s[k]);
}
