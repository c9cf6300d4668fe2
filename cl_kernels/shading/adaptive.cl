// Adaptive refinement (thesis 6.1.1, step 1): shading at every pixel where it changes from sample to sample.
// Provides mark_edges, mark_varying, mark_shown, refine_virtual, refine_real.
#include "direction_sets.clh"
#include "shadows.clh"
#include "upsample.clh"

// Normals of a smooth surface turn less from pixel to pixel, about 25 degrees.
#define SMOOTH_COSINE 0.9f

// Whether a virtual surface goes on from pixel `at` to its neighbour.
static inline int goes_on(global const float4 *positions, global const float4 *normals, const int at, const int neighbour,
                          const float tolerance_m) {
    const float4 here = positions[at], there = positions[neighbour];
    const float3 offset = there.xyz - here.xyz;
    return there.w > 0.0f && dot(normals[at].xyz, normals[neighbour].xyz) > SMOOTH_COSINE &&
           fabs(dot(offset, normals[at].xyz)) < tolerance_m + 0.3f * length(offset);
}

// positions, normals [h][w]: virtual surface -> edges [h][w]: 1 where it ends, bends or steps beside a pixel that it covers.
kernel void mark_edges(const int width, const int height, global const float4 *positions, global const float4 *normals,
                       const float tolerance_m, global uchar *edges) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int at = y * width + x;
    int edge = 0;
    if (positions[at].w > 0.0f) {
        edge |= x > 0 && !goes_on(positions, normals, at, at - 1, tolerance_m);
        edge |= x < width - 1 && !goes_on(positions, normals, at, at + 1, tolerance_m);
        edge |= y > 0 && !goes_on(positions, normals, at, at - width, tolerance_m);
        edge |= y < height - 1 && !goes_on(positions, normals, at, at + width, tolerance_m);
    }
    edges[at] = (uchar)edge;
}

// Mean of the valid samples of a 4 x 4 block from (row, col) on, which together use all sets of a lattice: single samples
// already differ by their directions. w = 0 without any.
static float4 block_mean(const int cols, const int rows, global const float4 *ratio, const int row, const int col) {
    float4 sum = (float4)(0.0f);
    for (int r = max(row, 0); r <= min(row + 3, rows - 1); r++) {
        for (int c = max(col, 0); c <= min(col + 3, cols - 1); c++) {
            const float4 v = ratio[r * cols + c];
            if (v.w > 0.0f) sum += (float4)(v.xyz, 1.0f);
        }
    }
    return sum.w > 0.0f ? (float4)(sum.xyz / sum.w, 1.0f) : (float4)(0.0f);
}

static inline float greatest_change(const float4 a, const float4 b) {
    const float3 change = fabs(a.xyz - b.xyz) * a.w * b.w;
    return fmax(fmax(change.x, change.y), change.z);
}

// ratio [rows][cols] (w = 1 valid) -> varying [rows + 1][cols + 1]: whether the means of the 4 x 4 samples on two opposite
// sides of a cell, which begins at sample (row - 1, col - 1), differ by more than `least_change`.
kernel void mark_varying(const int cols, const int rows, global const float4 *ratio, const float least_change,
                         global uchar *varying) {
    const int cell_col = (int)get_global_id(0) - 1;
    const int cell_row = (int)get_global_id(1) - 1;
    if (cell_col >= cols || cell_row >= rows) return;
    const float across = greatest_change(block_mean(cols, rows, ratio, cell_row - 1, cell_col - 3),
                                         block_mean(cols, rows, ratio, cell_row - 1, cell_col + 1));
    const float along = greatest_change(block_mean(cols, rows, ratio, cell_row - 3, cell_col - 1),
                                        block_mean(cols, rows, ratio, cell_row + 1, cell_col - 1));
    varying[(cell_row + 1) * (cols + 1) + cell_col + 1] = (uchar)(fmax(across, along) > least_change);
}

// real, virtual [h][w]: positions (w = 1 where there is surface); eye: the camera's. -> shown [h][w]: 0 where the virtual one hides
// the real one.
kernel void mark_shown(const int width, const int height, global const float4 *real, global const float4 *virtual_positions,
                       const float4 eye, global uchar *shown) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const float4 there = real[y * width + x], here = virtual_positions[y * width + x];
    const float3 to_real = there.xyz - eye.xyz, to_virtual = here.xyz - eye.xyz;
    shown[y * width + x] = !(here.w > 0.0f && (there.w <= 0.0f || dot(to_virtual, to_virtual) < dot(to_real, to_real)));
}

// Radiance that occluders take from the virtual surface at `pixels` [listed]; positions, normals, shown [h][w]: the virtual geometry
// buffer. scene.every: as in shadow_virtual; the picture is a mean over 4 x 4 pixels (upsample.clh).
// -> occluded [h][w] (rgb, w = 1); other pixels are not written.
//
// An item traces bundles of rays already. The hint keeps Intel's runtime for processors from bundling items too, which it does wrongly here
// (2026.2: values of other items, NaN).
kernel __attribute__((vec_type_hint(float8))) void refine_virtual(SCENE_PARAMETERS, const int listed, global const int *pixels,
                                                                  global const float4 *positions, global const float4 *normals,
                                                                  global const int *shown, global float4 *occluded) {
    const int item = get_global_id(0);
    if (item >= listed) return;
    const int pixel = pixels[item];
    const Volume volume = VOLUME_OF_SCENE;
    const Objects things = OBJECTS_OF_SCENE(own_offset_m(scene.objects.count, grids_of(object_table), shown[pixel]));
    const Arriving arrives = ARRIVING_OF_SCENE(place_of_object(scene.light.table, light_table, shown[pixel]));
    const int x = pixel % scene.samples.width, y = pixel / scene.samples.width;
    occluded[pixel] = taken_from_virtual(volume, things, arrives, positions[pixel], normals[pixel].xyz, direction_set(y, x),
                                         direction_subset(y, x, scene.every), scene.every);
}

// The ratio R' / R of shading with virtual objects to shading without, at `pixels` [listed] of the real surface. The
// objects' part is computed at the pixel; R changes little from sample to sample and is interpolated: shaded [rows][cols].
// -> ratio [h][w] (rgb, w = 1), w = 0 where there is no surface; other pixels are left as they are.
kernel void refine_real(REAL_SCENE_PARAMETERS, const int listed, global const int *pixels, global const float4 *positions,
                        global const float4 *normals, global const float4 *shaded, global float4 *ratio) {
    const int item = get_global_id(0);
    if (item >= listed) return;
    const int pixel = pixels[item];
    const int x = pixel % scene.samples.width, y = pixel / scene.samples.width;
    float4 result = (float4)(0.0f);
    if (positions[pixel].w > 0.0f && normals[pixel].w > 0.0f) {
        const Volume volume = SOLIDS_OF_SCENE;
        const Objects things = OBJECTS_OF_SCENE(0.0f);
        const int place = place_near(scene.light.table, light_table, positions[pixel].xyz);
        const Arriving arrives = ARRIVING_UNCHANGED(place);
        const float4 without = upsample(scene.samples, shaded, positions, normals, x, y, volume.voxel_m);
        const float3 taken = taken_from_real(volume, things, arrives, scene.objects.ball, positions[pixel].xyz, normals[pixel].xyz,
                                             direction_set(y, x), direction_subset(y, x, scene.every), scene.every, 0, 1, 0);
        const float3 floor = LEAST_SHADING * 0.28209479f * coefficients_of(scene.light.table, light_table, place)[0].xyz + 1e-9f;
        result = (float4)(fmax(without.xyz - taken, floor) / fmax(without.xyz, floor), without.w);
    }
    ratio[pixel] = result;
}
