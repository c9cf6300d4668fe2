// Which cells of the sphere light each part of the picture, and the normal equations of the cells' radiances.
// Provides pool_cells, hide_cells, accumulate_cells, project_pools, take_pools.
#ifndef CELLS
#error CELLS must be defined: a multiple of 8
#endif
#include "continued.clh"

#define COLUMNS (CELLS + 8)
#define BLOCKS (COLUMNS / 8)
#define SPOKES 4  // directions of a cell that are tried
#define LEAST_COSINE 0.05f  // directions nearer to the horizon of a pool are below that of some of its samples

// Two samples see the same light if they lie on one plane to within a voxel a few voxels away and face the same way.
static inline int same_surface(const float4 position, const float4 normal, const float4 other, const float4 other_normal,
                               const float voxel_m) {
    const float3 offset = other.xyz - position.xyz;
    return dot(normal.xyz, other_normal.xyz) > 0.9f && fabs(dot(offset, normal.xyz)) < voxel_m + 0.1f * length(offset);
}

// Two samples show the same material if their colours differ by less than shading does nearby.
static inline int same_color(const float4 seen, const float4 other) {
    const float3 apart = fabs(seen.xyz - other.xyz), most = 0.12f * fmax(seen.xyz, other.xyz);
    return apart.x <= most.x && apart.y <= most.y && apart.z <= most.z;
}

// Mean of max(x, 0) over a cell whose middle has cosine x and whose cosines reach so far to both sides.
static inline float clamped_mean(const float x, const float reach) {
    return x >= reach ? x : x <= -reach ? 0.0f : (x + reach) * (x + reach) / (4.0f * reach);
}

// One item a pool: the samples from `step / 2` before to `step + step / 2 - 1` after every `step`-th one, as far as they are
// usable, on its surface and of its colour. Each was traced along other directions, and together they fill the cells.
// positions, normals [h][w]; free_mask [rows][cols][MASK_WORDS], sets [rows][cols][INTERLEAVE] (see Transfer), observed
// [rows][cols] (rgb, w = 1 usable), hits [rows][cols]: what was seen of the surfaces that hide directions, see indirect.cl;
// directions [256][count] (unit, sr), cell_of [256][count], centers [CELLS]; unseen: radiance of surface that no picture shows
// -> of every pool, of white surface: pools [CELLS]: the share of its cosine-weighted sky that is each cell and is free (what
// is sampled is how much of a cell is hidden; an open surface has no sampling error); seen: its mean radiance, what surfaces
// send it, the share of its sky that is surface no picture shows, and the share of the samples used; place: where its middle
// lies, its normal, and the sum of its cells. The first pool's are at `first_pool` of pools and of place, not of seen.
kernel void pool_cells(const int pool_cols, const int pool_rows, const int cols, const int rows, const int step,
                       const int stride, const int width, global const float4 *positions, global const float4 *normals,
                       global const uint *free_mask, global const uchar *sets, global const float4 *observed,
                       global const float4 *hits, const int count, global const float4 *directions,
                       global const uchar *cell_of, global const float4 *centers, const float half_cell,
                       const float4 unseen, const float voxel_m, const int first_pool, global float *pools, global float8 *seen,
                       global float8 *place) {
    const int pool_col = get_global_id(0);
    const int pool_row = get_global_id(1);
    if (pool_col >= pool_cols || pool_row >= pool_rows) return;
    const int col = pool_col * step, row = pool_row * step;
    const int pool = pool_row * pool_cols + pool_col;
    const int middle = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 color = observed[row * cols + col];
    global float *own = pools + (first_pool + pool) * CELLS;
    for (int k = 0; k < CELLS; k++) own[k] = 0.0f;
    seen[pool] = (float8)(0.0f);
    place[first_pool + pool] = (float8)(0.0f);
    if (color.w <= 0.0f) return;

    const int2 first = (int2)(max(col - step / 2, 0), max(row - step / 2, 0));
    const int2 last = (int2)(min(col + step + step / 2, cols), min(row + step + step / 2, rows)) - 1;
    float3 normal = (float3)(0.0f);
    float4 sum = (float4)(0.0f), hit = (float4)(0.0f);
    for (int r = first.y; r <= last.y; r++) {
        for (int c = first.x; c <= last.x; c++) {
            const int pixel = middle + ((r - row) * width + c - col) * stride;
            const float4 here = observed[r * cols + c];
            if (here.w <= 0.0f || !same_color(color, here) ||
                !same_surface(positions[middle], normals[middle], positions[pixel], normals[pixel], voxel_m)) continue;
            normal += normals[pixel].xyz;
            sum += here;
            hit += hits[r * cols + c];
        }
    }
    normal = normalize(normal);

    float all[CELLS], open[CELLS];
    float all_sky = 0.0f, open_sky = 0.0f;
    for (int k = 0; k < CELLS; k++) all[k] = open[k] = 0.0f;
    for (int r = first.y; r <= last.y; r++) {
        for (int c = first.x; c <= last.x; c++) {
            const int pixel = middle + ((r - row) * width + c - col) * stride;
            const int sample = r * cols + c;
            if (observed[sample].w <= 0.0f || !same_color(color, observed[sample]) ||
                !same_surface(positions[middle], normals[middle], positions[pixel], normals[pixel], voxel_m)) continue;
            for (int j = 0; j < count; j++) {
                const int from = sets[sample * INTERLEAVE + j % INTERLEAVE] * count + j;
                const float cosine = dot(normal, directions[from].xyz);
                if (cosine < LEAST_COSINE) continue;
                const float free = (free_mask[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1 ? cosine : 0.0f;
                all[cell_of[from]] += cosine;
                open[cell_of[from]] += free;
                all_sky += cosine;
                open_sky += free;
            }
        }
    }
    float total = 0.0f, free_sky = 0.0f;
    for (int k = 0; k < CELLS; k++) total += clamped_mean(dot(normal, centers[k].xyz), half_cell);
    const float openness = all_sky > 0.0f ? open_sky / all_sky : 0.0f;
    for (int k = 0; k < CELLS; k++) {
        const float share = clamped_mean(dot(normal, centers[k].xyz), half_cell) / total;
        own[k] = share * (all[k] > 0.0f ? open[k] / all[k] : openness);
        free_sky += own[k];
    }
    const float hidden = fmax(1.0f - free_sky, 0.0f);
    const float known = hit.w > 0.0f ? fmin(hit.w / fmax(all_sky - open_sky, 1e-6f), 1.0f) : 0.0f;
    const float3 sent = hidden * (known * hit.xyz / fmax(hit.w, 1e-6f) + (1.0f - known) * unseen.xyz);
    seen[pool] = (float8)(sum.xyz / sum.w, sent, hidden * (1.0f - known), sum.w / (4.0f * step * step));
    place[first_pool + pool] = (float8)(positions[middle].xyz, 1.0f, normal, free_sky);
}

// One item a pool. places [count]; planes ... cell_m: see continued.clh; directions [CELLS][SPOKES]: each cell's, unit
// -> pools [count][CELLS] = raw [count][CELLS] times the share of a cell's directions that meet no plane.
kernel void hide_cells(const int count, const int first, global const float8 *places, const int plane_count,
                       global const float4 *planes, global const int4 *shapes, global const uchar *maps, const float cell_m,
                       const float least_m, global const float4 *directions, global const float *raw, global float *pools) {
    const int pool = get_global_id(0);
    if (pool >= count) return;
    const float8 place = places[first + pool];
    const Continued continued = {plane_count, planes, shapes, maps, cell_m, least_m};
    for (int k = 0; k < CELLS; k++) {
        const int index = (first + pool) * CELLS + k;
        int hidden = 0;
        for (int spoke = 0; spoke < SPOKES && raw[index] > 0.0f; spoke++) {
            hidden += is_hidden(continued, place.s012, directions[SPOKES * k + spoke].xyz);
        }
        pools[index] = raw[index] * (SPOKES - hidden) / SPOKES;
    }
}

// One item a block of 8 x 8 sums over the pools of one chunk, of the blocks on and above the diagonal. A row is the pool's
// cells and then its target.
// numbers [count]: which of pools [..][CELLS], targets [count], weights [count] -> partial [chunk][block][8][8]: sum w row^T
// row, blocks row by row.
kernel void accumulate_cells(const int count, const int chunk_size, global const int *numbers, global const float *pools,
                             global const float8 *targets, global const float *weights, global float *partial) {
    const int block = get_global_id(0);
    const int chunk = get_global_id(1);
    if (block >= BLOCKS * (BLOCKS + 1) / 2 || chunk * chunk_size >= count) return;
    int high = 0;
    int low = block;
    while (low >= BLOCKS - high) low -= BLOCKS - high++;
    low += high;
    float8 sums[8];
    for (int i = 0; i < 8; i++) sums[i] = (float8)(0.0f);
    const int end = min((chunk + 1) * chunk_size, count);
    for (int pool = chunk * chunk_size; pool < end; pool++) {
        global const float *row = pools + numbers[pool] * CELLS;
        const float8 a = weights[pool] * (high < BLOCKS - 1 ? vload8(high, row) : targets[pool]);
        const float8 b = low < BLOCKS - 1 ? vload8(low, row) : targets[pool];
        sums[0] += a.s0 * b;
        sums[1] += a.s1 * b;
        sums[2] += a.s2 * b;
        sums[3] += a.s3 * b;
        sums[4] += a.s4 * b;
        sums[5] += a.s5 * b;
        sums[6] += a.s6 * b;
        sums[7] += a.s7 * b;
    }
    global float *out = partial + (chunk * (BLOCKS * (BLOCKS + 1) / 2) + block) * 64;
    for (int i = 0; i < 8; i++) vstore8(sums[i], i, out);
}

// pools [count][CELLS], lobes [CELLS][8 groups] radiances of the cells -> shading [count][8 groups]: what each pool of white
// surface would show under each. One item eight lobes of a pool.
kernel void project_pools(const int count, const int groups, const int first, global const float *pools,
                          global const float *lobes, global float *shading) {
    const int group = get_global_id(0);
    const int pool = get_global_id(1);
    if (group >= groups || pool >= count) return;
    global const float *row = pools + (first + pool) * CELLS;
    float8 sum = (float8)(0.0f);
    for (int k = 0; k < CELLS; k++) sum += row[k] * vload8(k * groups + group, lobes);
    vstore8(sum, pool * groups + group, shading);
}

// Some pools, one after the other: chosen [count], pools [..][CELLS] -> taken [count][CELLS]. One item a cell of a pool.
kernel void take_pools(const int count, global const int *chosen, global const float *pools, global float *taken) {
    const int cell = get_global_id(0);
    const int number = get_global_id(1);
    if (cell >= CELLS || number >= count) return;
    taken[number * CELLS + cell] = pools[chosen[number] * CELLS + cell];
}
