// Surface measurement (thesis 5.1.1): removes lens distortion from colour and depth, removes the gamma, marks usable radiance.
// Provides measure.
#include "camera.clh"

#ifdef LINEAR16
typedef ushort color_t;
#else
typedef uchar color_t;
#endif

// Usable radiance lies above the sensor's black and below clipping; outside it a pixel says nothing linear about light.
#define BLACK 0.0015f
#define CLIPPED 0.985f

static inline float3 linear_color(global const color_t *color, global const float *to_linear, const int pixel) {
    global const color_t *c = color + 3 * pixel;
    return (float3)(to_linear[c[0]], to_linear[c[1]], to_linear[c[2]]);
}

static inline float brightest(const float3 rgb) {
    return fmax(fmax(rgb.x, rgb.y), rgb.z);
}

// Where a rectified pixel lies in the distorted picture (Brown's polynomial, third degree in r^2).
static inline float2 distort(const float4 intrinsics, const float8 k, const float u, const float v) {
    const float3 p = unproject(intrinsics, u, v);
    const float r2 = p.x * p.x + p.y * p.y;
    const float radial = 1.0f + r2 * (k.s0 + r2 * (k.s1 + r2 * k.s4));
    const float x = p.x * radial + 2.0f * k.s2 * p.x * p.y + k.s3 * (r2 + 2.0f * p.x * p.x);
    const float y = p.y * radial + k.s2 * (r2 + 2.0f * p.y * p.y) + 2.0f * k.s3 * p.x * p.y;
    return (float2)(intrinsics.s0 * x + intrinsics.s2, intrinsics.s1 * y + intrinsics.s3);
}

// color [h][w][3], depth [h][w] in units of depth_scale_m (0 = none), to_linear: radiance per code value.
// -> radiance [h][w] (rgb linear, w = 1 usable, 0 black or clipped, -1 outside the picture), depth_m [h][w] metres, 0 = none.
kernel void measure(const int width, const int height, global const color_t *color, global const ushort *depth,
                    global const float *to_linear, const float4 intrinsics, const float8 distortion,
                    const float depth_scale_m, const float greatest_depth_m,
                    global float4 *radiance, global float *depth_m) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
#ifdef DISTORTED
    const float2 source = distort(intrinsics, distortion, x, y);
    const int inside = source.x >= 0.0f && source.y >= 0.0f && source.x <= width - 1.0f && source.y <= height - 1.0f;
    const int x0 = inside ? min((int)source.x, width - 2) : 0;
    const int y0 = inside ? min((int)source.y, height - 2) : 0;
    const float fx = source.x - x0;
    const float fy = source.y - y0;
    const int corner = y0 * width + x0;
    const float3 a = linear_color(color, to_linear, corner), b = linear_color(color, to_linear, corner + 1);
    const float3 c = linear_color(color, to_linear, corner + width), d = linear_color(color, to_linear, corner + width + 1);
    const float3 rgb = mix(mix(a, b, fx), mix(c, d, fx), fy);
    const float3 peak = fmax(fmax(a, b), fmax(c, d));  // a mean that a clipped pixel takes part in is no radiance
    const ushort units = inside ? depth[(int)(source.y + 0.5f) * width + (int)(source.x + 0.5f)] : 0;
#else
    const int inside = 1;
    const float3 rgb = linear_color(color, to_linear, pixel);
    const float3 peak = rgb;
    const ushort units = depth[pixel];
#endif
    const float usable = brightest(rgb) > BLACK && brightest(peak) < CLIPPED ? 1.0f : 0.0f;
    const float metres = units == 65535 ? 0.0f : units * depth_scale_m;
    radiance[pixel] = inside ? (float4)(rgb, usable) : (float4)(0.0f, 0.0f, 0.0f, -1.0f);
    depth_m[pixel] = metres <= greatest_depth_m ? metres : 0.0f;
}
