// Registration of depth from another lens to the colour picture (thesis 5.1.1): the measured surface as the colour lens sees it.
// Provides clear_depth, project_depth, splat_surface, splat_points, resolve_depth.
// The nearest depth wins by an integer minimum over the bits of positive floats, which compare like the floats; the result does
// not depend on the order.
#include "camera.clh"

#define NOTHING 0xffffffffu
#define LEAST_Z 0.01f

// Depths of neighbouring pixels at `z` are of one surface if they differ by less: a slope of 3, but at least 2 % for a sensor's
// quantisation, plus 5 mm.
static inline float same_surface_m(const float z, const float focal_px) {
    return fmax(0.02f, 3.0f / focal_px) * z + 0.005f;
}

kernel void clear_depth(const int count, global uint *surface, global uint *points) {
    const int i = get_global_id(0);
    if (i >= count) return;
    surface[i] = NOTHING;
    points[i] = NOTHING;
}

// depth [h][w] in units of depth_scale_m (0 and 65535: none), rays [h][w]: (x, y, 1 if it has a ray, -) at z = 1 of each pixel
// -> projected [h][w]: pixel (u, v) in the colour picture, 1 / z in its camera, z in the depth camera; all 0 = none.
kernel void project_depth(const int width, const int height, global const ushort *depth, global const float4 *rays,
                          const float depth_scale_m, const float greatest_depth_m, const float16 color_from_depth,
                          const float4 intrinsics, global float4 *projected) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const float4 ray = rays[pixel];
    const float z = depth[pixel] == 65535 ? 0.0f : depth[pixel] * depth_scale_m;
    const float3 point = transform_point(color_from_depth, z * (float3)(ray.xy, 1.0f));
    const int usable = z > 0.0f && z <= greatest_depth_m && ray.z > 0.0f && point.z > LEAST_Z;
    projected[pixel] = usable ? (float4)(project(intrinsics, point), 1.0f / point.z, z) : (float4)(0.0f);
}

// Twice the area of the triangle a, b, p; positive clockwise in the picture, whose y points down.
static inline float area(const float4 a, const float4 b, const float2 p) {
    return (b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x);
}

static inline int is_surface(const float4 a, const float4 b, const float4 c, const float focal_px) {
    const float nearest = min(min(a.w, b.w), c.w);
    const float farthest = max(max(a.w, b.w), c.w);
    return nearest > 0.0f && farthest - nearest < same_surface_m(nearest, focal_px);
}

// The first pixel of the picture at or after x; ceil() is much slower in PoCL.
static inline int next_pixel(const float x) {
    const int whole = (int)x;
    return x > 0.0f ? whole + (whole < x) : 0;
}

// Writes the depth of a triangle at the pixel centres that it covers; 1 / z is linear in the picture. Back faces are skipped.
static void splat_triangle(const float4 a, const float4 b, const float4 c, const int width, const int height,
                           const int greatest_px, global uint *surface) {
    const float whole = area(a, b, c.xy);
    const float left = min(min(a.x, b.x), c.x), right = max(max(a.x, b.x), c.x);
    const float top = min(min(a.y, b.y), c.y), bottom = max(max(a.y, b.y), c.y);
    if (!(whole > 0.0f) || right - left > greatest_px || bottom - top > greatest_px) return;
    if (right < 0.0f || bottom < 0.0f || left > width - 1.0f || top > height - 1.0f) return;
    const int first_x = next_pixel(left), last_x = min((int)right, width - 1);
    const int first_y = next_pixel(top), last_y = min((int)bottom, height - 1);
    for (int y = first_y; y <= last_y; y++) {
        for (int x = first_x; x <= last_x; x++) {
            const float2 p = (float2)(x, y);
            const float to_a = area(b, c, p), to_b = area(c, a, p), to_c = area(a, b, p);
            if (min(min(to_a, to_b), to_c) < 0.0f) continue;
            const float z = (to_a + to_b + to_c) / (to_a * a.z + to_b * b.z + to_c * c.z);
            atomic_min(surface + y * width + x, as_uint(z));
        }
    }
}

// One item a square of four neighbours of projected [h][w]: its two triangles, or one if a corner belongs to another surface.
// -> surface [height][width], bits of metres.
kernel void splat_surface(const int depth_width, const int depth_height, global const float4 *projected,
                          const float focal_px, const int width, const int height, const int greatest_px,
                          global uint *surface) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= depth_width - 1 || y >= depth_height - 1) return;
    const int pixel = y * depth_width + x;
    const float4 a = projected[pixel], b = projected[pixel + 1];
    const float4 c = projected[pixel + depth_width], d = projected[pixel + depth_width + 1];
    const int falling = is_surface(a, b, d, focal_px) + is_surface(a, d, c, focal_px);  // split from a to d
    const int rising = is_surface(a, b, c, focal_px) + is_surface(b, d, c, focal_px);  // split from b to c
    if (falling >= rising) {
        if (is_surface(a, b, d, focal_px)) splat_triangle(a, b, d, width, height, greatest_px, surface);
        if (is_surface(a, d, c, focal_px)) splat_triangle(a, d, c, width, height, greatest_px, surface);
    } else {
        if (is_surface(a, b, c, focal_px)) splat_triangle(a, b, c, width, height, greatest_px, surface);
        if (is_surface(b, d, c, focal_px)) splat_triangle(b, d, c, width, height, greatest_px, surface);
    }
}

// Writes every measurement to its nearest pixel, for surface that is too thin for a triangle.
// -> points [height][width], bits of metres.
kernel void splat_points(const int count, global const float4 *projected, const int width, const int height,
                         global uint *points) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const float4 p = projected[i];
    const int inside = p.z > 0.0f && p.x >= -0.5f && p.y >= -0.5f && p.x < width - 0.5f && p.y < height - 0.5f;
    if (inside) atomic_min(points + (int)(p.y + 0.5f) * width + (int)(p.x + 0.5f), as_uint(1.0f / p.z));
}

// The interpolated surface's depth at a pixel; the single measurement only where there is no surface, or one behind it.
// -> depth_m [count] metres, 0 = none.
kernel void resolve_depth(const int count, global const uint *surface, global const uint *points, const float focal_px,
                          const float greatest_depth_m, global float *depth_m) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const float point = points[i] == NOTHING ? 0.0f : as_float(points[i]);
    const float face = surface[i] == NOTHING ? 0.0f : as_float(surface[i]);
    const int use_point = points[i] != NOTHING && (surface[i] == NOTHING || face - point > same_surface_m(point, focal_px));
    const float z = use_point ? point : face;
    depth_m[i] = z <= greatest_depth_m ? z : 0.0f;
}
