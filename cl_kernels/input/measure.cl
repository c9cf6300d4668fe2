// Surface measurement (thesis 5.1.1): removes lens distortion from colour and depth, removes the gamma, marks usable radiance.
// Provides measure_color, measure_depth.
#include "camera.clh"
#include "radiance_marks.clh"

#ifdef LINEAR16
typedef ushort color_t;
#else
typedef uchar color_t;
#endif

// Usable radiance is above the sensor's black level and below CLIPPED, where pixels are linear in light.
#define BLACK 0.0015f

static inline float3 linear_color(global const color_t *color, global const float *to_linear, const int pixel) {
    global const color_t *c = color + 3 * pixel;
    return (float3)(to_linear[c[0]], to_linear[c[1]], to_linear[c[2]]);
}

static inline float brightest(const float3 rgb) {
    return fmax(fmax(rgb.x, rgb.y), rgb.z);
}

// Position of a rectified pixel in the distorted picture (Brown's polynomial, third degree in r^2).
static inline float2 distort(const float4 intrinsics, const float8 k, const float u, const float v) {
    const float3 p = unproject(intrinsics, u, v);
    const float r2 = p.x * p.x + p.y * p.y;
    const float radial = 1.0f + r2 * (k.s0 + r2 * (k.s1 + r2 * k.s4));
    const float x = p.x * radial + 2.0f * k.s2 * p.x * p.y + k.s3 * (r2 + 2.0f * p.x * p.x);
    const float y = p.y * radial + k.s2 * (r2 + 2.0f * p.y * p.y) + 2.0f * k.s3 * p.x * p.y;
    return (float2)(intrinsics.s0 * x + intrinsics.s2, intrinsics.s1 * y + intrinsics.s3);
}

static inline int is_inside(const int width, const int height, const float2 pixel) {
    return pixel.x >= 0.0f && pixel.y >= 0.0f && pixel.x <= width - 1.0f && pixel.y <= height - 1.0f;
}

// color [h][w][3], to_linear: radiance per code value
// -> radiance [h][w] (rgb linear, w = 1 usable, 0 black or clipped, -1 outside the picture).
kernel void measure_color(const int width, const int height, global const color_t *color, global const float *to_linear,
                          const float4 intrinsics, const float8 distortion, global float4 *radiance) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
#ifdef DISTORTED
    const float2 source = distort(intrinsics, distortion, x, y);
    const int inside = is_inside(width, height, source);
    const int x0 = inside ? min((int)source.x, width - 2) : 0;
    const int y0 = inside ? min((int)source.y, height - 2) : 0;
    const float fx = source.x - x0;
    const float fy = source.y - y0;
    const int corner = y0 * width + x0;
    const float3 a = linear_color(color, to_linear, corner), b = linear_color(color, to_linear, corner + 1);
    const float3 c = linear_color(color, to_linear, corner + width), d = linear_color(color, to_linear, corner + width + 1);
    const float3 rgb = mix(mix(a, b, fx), mix(c, d, fx), fy);
    const float3 peak = fmax(fmax(a, b), fmax(c, d));  // a mean with a clipped pixel is not usable
#else
    const int inside = 1;
    const float3 rgb = linear_color(color, to_linear, pixel);
    const float3 peak = rgb;
#endif
    const float usable = brightest(rgb) > BLACK && brightest(peak) < CLIPPED ? 1.0f : 0.0f;
    radiance[pixel] = inside ? (float4)(rgb, usable) : (float4)(0.0f, 0.0f, 0.0f, -1.0f);
}

// depth [h][w] in units of depth_scale_m (0 and 65535: none) -> depth_m [h][w] metres, 0 = none. Depths are not interpolated.
kernel void measure_depth(const int width, const int height, global const ushort *depth, const float4 intrinsics,
                          const float8 distortion, const float depth_scale_m, const float greatest_depth_m,
                          global float *depth_m) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
#ifdef DISTORTED
    const float2 source = distort(intrinsics, distortion, x, y);
    const int inside = is_inside(width, height, source);
    const ushort units = inside ? depth[(int)(source.y + 0.5f) * width + (int)(source.x + 0.5f)] : 0;
#else
    const ushort units = depth[y * width + x];
#endif
    const float metres = units == 65535 ? 0.0f : units * depth_scale_m;
    depth_m[y * width + x] = metres <= greatest_depth_m ? metres : 0.0f;
}
