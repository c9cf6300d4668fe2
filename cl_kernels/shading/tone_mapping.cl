// Tone mapping (thesis 7.1, H of eq. 7.1): mean luminances of the picture and of its shading, summed in fixed order.
// Provides shade_pairs, sum_rows.
#ifndef BANDS
#error BANDS must be defined: the number of spherical-harmonics bands
#endif
#include "real_shading.clh"
#include "samples.clh"
#include "sh.clh"

#define LUMINANCE (float3)(0.2126f, 0.7152f, 0.0722f)

// Every `every`-th sample of real surface that the camera saw neither clipped nor black: luminance of the picture, of R, and 1.
// radiance [h][w] (w = 1 usable); transfer [rows][cols][COEFFICIENTS]; hits [rows][cols]: see indirect.cl.
// -> pairs [pair_rows][pair_cols], 0 where there is no such sample.
kernel void shade_pairs(const Grid grid, SAMPLE_BUFFERS, global const float4 *radiance, global const float *transfer,
                        global const float4 *hits, const LightParameters lit, LIGHT_BUFFERS, const int every, const int pair_cols,
                        const int pair_rows,
                        global float4 *pairs) {
    const int pair_col = get_global_id(0);
    const int pair_row = get_global_id(1);
    if (pair_col >= pair_cols || pair_row >= pair_rows) return;
    const int col = pair_col * every, row = pair_row * every;
    const int sample = row * grid.cols + col;
    const int pixel = sample_pixel(grid, row, col);
    const float4 seen = radiance[pixel];
    float4 pair = (float4)(0.0f);
    if (seen.w > 0.0f && positions[pixel].w > 0.0f && normals[pixel].w > 0.0f && openness[sample] >= 0.0f) {
        const int place = place_near(lit.table, light_table, positions[pixel].xyz);
        const Arriving arrives = make_arriving(lit, directions, light_table, place, 0, nothing_changed());
        global const float4 *light = coefficients_of(lit.table, light_table, place);
        float3 shaded = (float3)(0.0f);
        for (int i = 0; i < COEFFICIENTS; i++) shaded += transfer[sample * COEFFICIENTS + i] * light[i].xyz;
        shaded = shading_without(arrives, shaded, openness[sample], hits[sample]);
        pair = (float4)(dot(LUMINANCE, seen.xyz), dot(LUMINANCE, fmax(shaded, 0.0f)), 1.0f, 0.0f);
    }
    pairs[pair_row * pair_cols + pair_col] = pair;
}

// pairs [rows][cols] -> sums [rows].
kernel void sum_rows(const int cols, const int rows, global const float4 *pairs, global float4 *sums) {
    const int row = get_global_id(0);
    if (row >= rows) return;
    float4 sum = (float4)(0.0f);
    for (int col = 0; col < cols; col++) sum += pairs[row * cols + col];
    sums[row] = sum;
}
