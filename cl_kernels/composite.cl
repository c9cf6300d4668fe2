// Compositing (thesis 7.2.1, R3): real hides virtual and virtual hides real; linear inside, sRGB at the end.
// Provides composite.
#include "camera.clh"
#include "lanes.clh"
#include "sampled_value.clh"
#include "upsample_row.clh"

#ifndef SUBPIXELS
#define SUBPIXELS 0
#endif
#ifndef BANDS
#error BANDS must be defined: the number of spherical-harmonics bands
#endif
#include "open_shading.clh"

// codes [65536]: sRGB code of linear radiance i / 65535.
static inline void write_color(global uchar *picture, const int pixel, const float3 linear, global const uchar *codes) {
    const float3 level = clamp(linear, 0.0f, 1.0f) * 65535.0f + 0.5f;
    picture[3 * pixel] = codes[(int)level.x];
    picture[3 * pixel + 1] = codes[(int)level.y];
    picture[3 * pixel + 2] = codes[(int)level.z];
}

// The virtual geometry buffer and what occluders take from it.
typedef struct {
    global const float4 *positions;
    global const float4 *normals;
    global const float4 *colors;
    Grid grid;
    global const float4 *occluded;
    global const float4 *refined;
    int has_refined;
    global const float4 *reflected;
    global const float4 *direct;
} Virtual;

// Radiance of the virtual surface at pixel (x, y), which it covers.
static float3 virtual_color(const Virtual things, global const float4 *light, const int x, const int y, const int height,
                            const float tolerance_m) {
    const int pixel = y * things.grid.width + x;
    const float4 taken = value_at(things.grid, things.occluded, things.refined, things.has_refined, things.positions, things.normals,
                                  x, y, height, tolerance_m);
    float3 shading = fmax(open_shading(things.normals[pixel].xyz, light) - taken.xyz, (float3)(0.0f));
#ifdef HAS_DIRECT
    shading += things.direct[pixel].xyz;
#endif
    const float3 diffuse = things.colors[pixel].xyz * shading;
#ifdef HAS_GLOSS
    return things.reflected[pixel].w * diffuse + things.reflected[pixel].xyz;
#else
    return diffuse;
#endif
}

#if SUBPIXELS > 0
// Of the pixel's parts, the share at which an object is no farther than `tolerance_m` behind the real surface, of depth
// `real_z`, 0 where there is none. nearest [SUBPIXELS h][SUBPIXELS w]: bits of 1 / depth, 0 where there is no object.
static float share_covered(global const uint *nearest, const int x, const int y, const int width, const float real_z,
                           const float tolerance_m) {
    int covered = 0;
    for (int part = 0; part < SUBPIXELS * SUBPIXELS; part++) {
        const int row = SUBPIXELS * y + part / SUBPIXELS, col = SUBPIXELS * x + part % SUBPIXELS;
        const float inverse_z = as_float(nearest[row * SUBPIXELS * width + col]);
        covered += inverse_z > 0.0f && (real_z <= 0.0f || (real_z + tolerance_m) * inverse_z > 1.0f);
    }
    return (float)covered / (SUBPIXELS * SUBPIXELS);
}

// The pixel itself where the virtual surface covers its middle, else one beside it that has it, else -1: x + y width.
static int covered_near(global const float4 *positions, const int x, const int y, const int width, const int height) {
    const int2 steps[9] = {(int2)(0, 0), (int2)(-1, 0), (int2)(1, 0), (int2)(0, -1), (int2)(0, 1),
                           (int2)(-1, -1), (int2)(1, -1), (int2)(-1, 1), (int2)(1, 1)};
    for (int k = 0; k < 9; k++) {
        const int u = x + steps[k].x, v = y + steps[k].y;
        if (u >= 0 && v >= 0 && u < width && v < height && positions[v * width + u].w > 0.0f) return v * width + u;
    }
    return -1;
}
#endif

// Whether anything virtual may change the LANES pixels of a row from x on; see composite.
static inline int may_change(const int x, const int y, const int width, const int cols, const int stride, global const uchar *touched,
                             global const float4 *direct_ratio, global const float4 *virtual_positions, global const uint *nearest) {
    int any_change = 0;
    for (int lane = 0; lane < LANES; lane++) {
#if defined(HAS_SHADOWS) && defined(HAS_DIRECT)
        any_change |= direct_ratio[y * width + x + lane].w > 0.0f;
#elif defined(HAS_SHADOWS)
        any_change |= touched[(cell_of(y, stride) + 1) * (cols + 1) + cell_of(x + lane, stride) + 1] != 0;
#endif
#if defined(HAS_OBJECTS) && SUBPIXELS == 0
        any_change |= virtual_positions[y * width + x + lane].w > 0.0f;
#endif
    }
#ifdef HAS_OBJECTS
    for (int row = SUBPIXELS * y; row < SUBPIXELS * (y + 1); row++)
        for (int i = 0; i < SUBPIXELS * LANES; i++) any_change |= nearest[SUBPIXELS * (row * width + x) + i] != 0;
#endif
    return any_change;
}

#if defined(HAS_SHADOWS) && !defined(HAS_DIRECT)
// By what virtual things multiply real surface at LANES pixels of a row from x on -> factors [LANES], w = 0 where they do not.
static void factors_of(const Grid grid, global const float4 *ratio, const int has_refined, global const float4 *refined,
                       global const uchar *touched, global const float4 *positions, global const float4 *normals, const int x,
                       const int y, const int height, const float tolerance_m, float4 *factors) {
    global const uchar *cells = touched + (cell_of(y, grid.stride) + 1) * (grid.cols + 1) + 1;
    int counts[LANES], any_counts = 0;
    for (int lane = 0; lane < LANES; lane++) {
        const int pixel = y * grid.width + x + lane;
        factors[lane] = (float4)(0.0f);
        counts[lane] = x + lane < grid.width && cells[cell_of(x + lane, grid.stride)] && positions[pixel].w > 0.0f;
#ifndef BICUBIC
        any_counts |= counts[lane];
        if (!has_refined || !counts[lane] || refined[pixel].w <= 0.0f) continue;
#else
        if (!counts[lane]) continue;
#endif
        counts[lane] = 0;
        factors[lane] = value_at(grid, ratio, refined, has_refined, positions, normals, x + lane, y, height, tolerance_m);
    }
    if (!any_counts) return;
    float a[LANES], b[LANES], c[LANES];
    int known[LANES];
    intn found;
    const Vectors mean = upsample_row(grid, ratio, positions, normals, row_from(grid, positions, normals, x, y), tolerance_m, &found);
    STORE_LANES(mean.x, a);
    STORE_LANES(mean.y, b);
    STORE_LANES(mean.z, c);
    STORE_LANES(found, known);
    for (int lane = 0; lane < LANES; lane++)
        if (counts[lane] && known[lane]) factors[lane] = (float4)(a[lane], b[lane], c[lane], 1.0f);
}
#endif

static inline void copy_codes(global const uchar *shown, global uchar *picture, const int pixel) {
#if LANES == 8
    for (int i = 0; i < 3; i++) vstore8(vload8(i, shown + 3 * pixel), i, picture + 3 * pixel);
#else
    for (int i = 0; i < 3 * LANES; i++) picture[3 * pixel + i] = shown[3 * pixel + i];
#endif
}

// shown [h][w][3]: the camera picture as sRGB codes; radiance [h][w] linear. positions, normals: the real geometry buffer.
// virtual_positions, virtual_normals, virtual_colors [h][w] (w = 1 where covered): the virtual one, or none without HAS_OBJECTS;
// nearest: see share_covered, where SUBPIXELS is not 0; else pixels are covered as their middles are.
// reflected [h][w]: see reflect.cl, or none without HAS_GLOSS. virtual_gain: picture radiance over the light's, on virtual surface.
// occluded [object_rows][object_cols]: radiance that occluders take from virtual samples (w = 1 valid);
// ratio [rows][cols]: shaded with over without virtual objects on real samples (w = 1 valid), touched: see reached.cl; or
// none without HAS_SHADOWS. refined_occluded, refined_ratio [h][w]: the same at pixels that have w = 1, or none where has_... is 0.
// HAS_DIRECT: `light` and occluded are of the rest of the light; direct_virtual [h][w]: what its discs bring to virtual surface;
// direct_ratio [h][w] (w = 1 where it counts): ratio of all of it, which then stands for `ratio`.
// BICUBIC: samples are mixed across edges. codes [65536]: sRGB code of linear radiance i / 65535.
// One item LANES pixels of a row -> picture [h][w][3] sRGB. A pixel that nothing virtual touches is the camera's, byte for byte.
kernel void composite(const int width, const int height, global const uchar *shown, global const float4 *radiance,
                      global const float4 *positions, global const float4 *normals, const float16 camera_from_volume,
                      const float tolerance_m,
                      global const float4 *virtual_positions, global const float4 *virtual_normals,
                      global const float4 *virtual_colors, global const uint *nearest, global const float4 *reflected,
                      global const float4 *light, const float virtual_gain,
                      const int object_cols, const int object_rows, const int object_stride, global const float4 *occluded,
                      const int cols, const int rows, const int stride, global const float4 *ratio,
                      global const uchar *touched, const int has_refined_occluded, global const float4 *refined_occluded,
                      const int has_refined_ratio, global const float4 *refined_ratio,
                      global const float4 *direct_virtual, global const float4 *direct_ratio, global const uchar *codes, global uchar *picture) {
    const int first = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    if (first >= width || y >= height) return;
    if (first + LANES <= width && !may_change(first, y, width, cols, stride, touched, direct_ratio, virtual_positions, nearest)) {
        copy_codes(shown, picture, y * width + first);
        return;
    }
#if defined(HAS_SHADOWS) && !defined(HAS_DIRECT)
    const Grid grid = {cols, rows, stride, width};
    float4 factors[LANES];
    factors_of(grid, ratio, has_refined_ratio, refined_ratio, touched, positions, normals, first, y, height, tolerance_m, factors);
#endif
    for (int x = first; x < min(first + LANES, width); x++) {
        const int pixel = y * width + x;
        const float4 real = positions[pixel];
        float4 color = radiance[pixel];  // of the real surface; w: whether anything virtual has to do with it
        color.w = 0.0f;
#ifdef HAS_SHADOWS
#ifdef HAS_DIRECT
        const float4 factor = direct_ratio[pixel];
#else
        const float4 factor = factors[x - first];
#endif
        if (factor.w > 0.0f && radiance[pixel].w >= 0.0f) {
            const float3 change = fabs(factor.xyz - 1.0f);
            if (fmax(fmax(change.x, change.y), change.z) > UNTOUCHED) color = (float4)(color.xyz * factor.xyz, 1.0f);
        }
#endif
#ifdef HAS_OBJECTS
        const Virtual things = {virtual_positions, virtual_normals, virtual_colors, {object_cols, object_rows, object_stride, width},
                                occluded, refined_occluded, has_refined_occluded, reflected, direct_virtual};
        const float real_z = real.w > 0.0f ? transform_point(camera_from_volume, real.xyz).z : 0.0f;
#if SUBPIXELS > 0
        const float share = share_covered(nearest, x, y, width, real_z, tolerance_m);
        const int source = share > 0.0f ? covered_near(virtual_positions, x, y, width, height) : -1;
#else
        const float ahead = real_z - transform_point(camera_from_volume, virtual_positions[pixel].xyz).z;
        const float share = virtual_positions[pixel].w > 0.0f && (real.w <= 0.0f || ahead > -tolerance_m) ? 1.0f : 0.0f;
        const int source = share > 0.0f ? pixel : -1;
#endif
        if (source >= 0) {
            const float3 own = virtual_gain * virtual_color(things, light, source % width, source / width, height, tolerance_m);
            const float part = radiance[pixel].w < 0.0f ? 1.0f : share;  // outside the camera's picture there is nothing to mix with
            color = (float4)(color.xyz + part * (own - color.xyz), 1.0f);
        }
#endif
        if (color.w > 0.0f)
            write_color(picture, pixel, color.xyz, codes);
        else
            for (int i = 0; i < 3; i++) picture[3 * pixel + i] = shown[3 * pixel + i];
    }
}
