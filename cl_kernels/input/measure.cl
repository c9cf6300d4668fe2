// Surface measurement (thesis 5.1.1): removes lens distortion from colour and depth, removes the gamma, marks usable radiance.
// Provides measure.
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

// Where a rectified pixel lies in the distorted picture.
typedef struct {
    int inside;
    float2 at;
} Source;

static Source source_of(const int width, const int height, const float4 intrinsics, const float8 distortion, const int x, const int y) {
#ifdef DISTORTED
    const float2 at = distort(intrinsics, distortion, x, y);
    const Source source = {is_inside(width, height, at), at};
#else
    const Source source = {1, (float2)(x, y)};
#endif
    return source;
}

// rgb linear, w = 1 usable, 0 black or clipped, -1 outside the picture.
static float4 measured_color(const int width, const int height, global const color_t *color, global const float *to_linear,
                             const Source source) {
#ifdef DISTORTED
    const int x = source.inside ? min((int)source.at.x, width - 2) : 0;
    const int y = source.inside ? min((int)source.at.y, height - 2) : 0;
    const float across = source.at.x - x, along = source.at.y - y;
    const int corner = y * width + x;
    const float3 a = linear_color(color, to_linear, corner), b = linear_color(color, to_linear, corner + 1);
    const float3 c = linear_color(color, to_linear, corner + width), d = linear_color(color, to_linear, corner + width + 1);
    const float3 rgb = mix(mix(a, b, across), mix(c, d, across), along);
    const float3 peak = fmax(fmax(a, b), fmax(c, d));  // a mean with a clipped pixel is not usable
#else
    const float3 rgb = linear_color(color, to_linear, (int)source.at.y * width + (int)source.at.x);
    const float3 peak = rgb;
#endif
    const float usable = brightest(rgb) > BLACK && brightest(peak) < CLIPPED ? 1.0f : 0.0f;
    return source.inside ? (float4)(rgb, usable) : (float4)(0.0f, 0.0f, 0.0f, -1.0f);
}

// Metres, 0 = none. Depths are not interpolated.
static float measured_depth(const int width, global const ushort *depth, const float depth_scale_m, const float greatest_depth_m,
                            const Source source) {
    const ushort units = source.inside ? depth[(int)(source.at.y + 0.5f) * width + (int)(source.at.x + 0.5f)] : 0;
    const float metres = units == 65535 ? 0.0f : units * depth_scale_m;
    return metres <= greatest_depth_m ? metres : 0.0f;
}

// color [h][w][3], to_linear: radiance per code value; depth [h][w] in units of depth_scale_m (0 and 65535: none), seen through the
// same lens; without ONE_LENS neither it nor depth_m is used -> radiance [h][w] as of measured_color; depth_m [h][w].
kernel void measure(const int width, const int height, global const color_t *color, global const float *to_linear,
                    const float4 intrinsics, const float8 distortion, global const ushort *depth, const float depth_scale_m,
                    const float greatest_depth_m, global float4 *radiance, global float *depth_m) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Source source = source_of(width, height, intrinsics, distortion, x, y);
    radiance[y * width + x] = measured_color(width, height, color, to_linear, source);
#ifdef ONE_LENS
    depth_m[y * width + x] = measured_depth(width, depth, depth_scale_m, greatest_depth_m, source);
#endif
}
