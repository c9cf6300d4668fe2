// Bounds on the change of real surface by virtual objects, without tracing. Provides bound_samples, bound_pixels.
//
// An object lies inside a ball. A sample's directions that miss all balls, or lie under its horizon, are not blocked by objects;
// every other direction loses at most the radiance that can arrive along it, or gains at most the radiance that objects send.
// Relative to R, the shading without objects, this bounds |R'/R - 1| (eq. 7.1); a pixel's ratio is a weighted mean of samples.
#ifndef BANDS
#error BANDS must be defined: the number of spherical-harmonics bands
#endif
#include "real_shading.clh"
#include "samples.clh"
#include "sampled_value.clh"
#include "sh.clh"

#define CHUNK 16
#define SPREAD 1.1f  // the directions' weights add up to 1, apart from the error of few directions

static inline float greatest(const float3 v) {
    return fmax(fmax(v.x, v.y), v.z);
}

// transfer [rows][cols][COEFFICIENTS]; hits [rows][cols]: see indirect.cl; at every `every`-th sample.
// balls [balls_count]: center, radius; sent, real_sent: bounds on the radiance from objects and from real surface (rgb).
// -> bounds [bound_rows][bound_cols]: greatest relative change of R by light that objects block or send; by light that they send;
// of bounced light relative to that change (w = 1 valid, 0 without surface). Without balls: 0, and the light from objects that
// block everything.
kernel void bound_samples(const Grid grid, SAMPLE_BUFFERS, global const float *transfer, global const float4 *hits,
                          const LightParameters lit, LIGHT_BUFFERS, const int balls_count, global const float4 *balls,
                          const float4 sent, const float4 real_sent, const int every, const int bound_cols, const int bound_rows,
                          global float4 *bounds) {
    const int bound_col = get_global_id(0);
    const int bound_row = get_global_id(1);
    if (bound_col >= bound_cols || bound_row >= bound_rows) return;
    const int col = bound_col * every, row = bound_row * every;
    const int sample = row * grid.cols + col;
    const int pixel = sample_pixel(grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    float4 bound = (float4)(0.0f);
    if (position.w > 0.0f && normal.w > 0.0f) {
        const int place = place_near(lit.table, light_table, position.xyz);
        const Arriving arrives = make_arriving(lit, directions, light_table, place, 0, nothing_changed());
        global const float4 *light = coefficients_of(lit.table, light_table, place);
        global const uint *free = free_mask + sample * MASK_WORDS;
        global const uchar *own = sets + sample * INTERLEAVE;
        const float3 most_hidden = fmax(real_sent.xyz, lit.unseen.xyz);
        float3 all = (float3)(0.0f);
        float part = 0.0f;
        for (int j = 0; j < lit.count && balls_count > 0; j++) {
            const int index = own[j % INTERLEAVE] * lit.count + j;
            const float3 direction = directions[index].xyz;
            int meets = 0;
            for (int k = 0; k < balls_count; k++) {
                float3 towards;
                const float least_cosine = ball_cosine(balls[k], position.xyz, &towards) - 1e-4f;
                meets |= dot(direction, towards) >= least_cosine;
            }
            if (!meets || dot(normal.xyz, direction) <= 0.0f) continue;
            const int is_free = (free[j >> 5] >> (j & 31)) & 1;
            const float share = share_of(arrives, index, normal.xyz);
            const float3 taken = is_free ? arrives.arriving[index].xyz : most_hidden;
            all += share * fmax(taken, sent.xyz);
            part += share;
        }
        if (balls_count == 0) part = SPREAD;
        float3 without = (float3)(0.0f);
        for (int i = 0; i < COEFFICIENTS; i++) without += transfer[sample * COEFFICIENTS + i] * light[i].xyz;
        without = shading_without(arrives, without, openness[sample], hits[sample]);
        without = fmax(without, LEAST_SHADING * 0.28209479f * light[0].xyz + 1e-9f);
        const float hidden = clamp(1.0f - openness[sample], 0.0f, 1.0f);
        bound = (float4)(greatest(all / without), part * greatest(sent.xyz / without), hidden * greatest(real_sent.xyz / without), 1.0f);
    }
    bounds[bound_row * bound_cols + bound_col] = bound;
}

// Whether a ball may block part of a disc's light at a surface point. disc: direction, half angle in radians.
static inline int dims(const float4 disc, const float4 ball, const float3 position, const float3 normal) {
    if (dot(normal, disc.xyz) <= -sin(disc.w)) return 0;
    const float3 offset = ball.xyz - position;
    const float distance = length(offset);
    if (distance <= ball.w) return 1;
    const float angle = acos(clamp(dot(offset, disc.xyz) / distance, -1.0f, 1.0f));
    return angle <= disc.w + asin(ball.w / distance) + 1e-3f;
}

// positions, normals [h][w] of real surface; bounds [rows][cols]: of bound_samples for every sample, or none where has_bounds is 0.
// discs [discs_count]: see dims. -> most [h][ceil(w / CHUNK)]: the greatest bounds of CHUNK pixels, 0 where no sample changes;
// w: whether a disc is dimmed.
kernel void bound_pixels(const int height, global const float4 *positions, global const float4 *normals,
                         const Grid grid, const int has_bounds, global const float4 *bounds, const float tolerance_m,
                         const int discs_count, global const float4 *discs, const int balls_count,
                         global const float4 *balls, global float4 *most) {
    const int chunk = get_global_id(0);
    const int y = get_global_id(1);
    const int width = grid.width, stride = grid.stride;
    const int chunks = (width + CHUNK - 1) / CHUNK;
    if (chunk >= chunks || y >= height) return;
    const int end = min(width, (chunk + 1) * CHUNK);
    int any = 0;  // of the samples that pixels here are means of
    for (int row = max(cell_of(y, stride) - 2, 0); has_bounds && row <= min(cell_of(y, stride) + 3, grid.rows - 1); row++)
        for (int col = max(cell_of(chunk * CHUNK, stride) - 2, 0); col <= min(cell_of(end - 1, stride) + 3, grid.cols - 1); col++)
            any |= bounds[row * grid.cols + col].x > 0.0f;
    float4 greatest_of = (float4)(0.0f);
    for (int x = chunk * CHUNK; x < end; x++) {
        const float4 position = positions[y * width + x];
        if (position.w <= 0.0f) continue;
        if (any) {
            const float4 mean = value_at(grid, bounds, bounds, 0, positions, normals, x, y, height, tolerance_m);
            greatest_of.xyz = fmax(greatest_of.xyz, mean.xyz);
        }
        for (int d = 0; d < discs_count; d++)
            for (int k = 0; k < balls_count; k++)
                if (dims(discs[d], balls[k], position.xyz, normals[y * width + x].xyz)) greatest_of.w = 1.0f;
    }
    most[y * chunks + chunk] = greatest_of;
}
