// Normal equations of the light (thesis eq. 5.5-5.6), summed in fixed order: one partial sum a tile of samples.
// Provides gather_samples, accumulate_tiles.
#ifndef COEFFICIENTS
#error COEFFICIENTS must be defined: the number of spherical-harmonics coefficients
#endif
#define TILE 8
#define TILE_SAMPLES 64
#define COLUMNS (COEFFICIENTS + 3)

#define LABEL_STATIC 1

// Mean usable radiance around each sample and its weight: 0 unless the sample lies on static surface with enough open sky.
// radiance [h][w] (w = 1 usable), labels [h][w], openness [rows][cols] -> observed [rows][cols] (rgb, weight).
kernel void gather_samples(const int cols, const int rows, const int stride, const int width, const int height,
                           global const float4 *radiance, global const uchar *labels, global const float *openness,
                           const float least_openness, global float4 *observed) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int x = stride / 2 + col * stride;
    const int y = stride / 2 + row * stride;
    float4 sum = (float4)(0.0f);
    int usable = openness[row * cols + col] >= least_openness;
    for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
            const int pixel = clamp(y + dy, 0, height - 1) * width + clamp(x + dx, 0, width - 1);
            const float4 here = radiance[pixel];
            usable = usable && here.w > 0.0f && labels[pixel] == LABEL_STATIC;
            sum += here;
        }
    }
    observed[row * cols + col] = usable ? (float4)(sum.xyz / 9.0f, 1.0f) : (float4)(0.0f);
}

// One work-group of 64 items a tile of 8 x 8 samples. With row vectors s = (transfer, r, g, b) of a tile's samples, its
// partial sum is the upper triangle of sum w s^T s, row by row, then sum w and the number of samples with w > 0.
// transfer [rows][cols][COEFFICIENTS], observed [rows][cols] (rgb, w) -> partial [tiles][COLUMNS (COLUMNS + 1) / 2 + 2].
kernel void accumulate_tiles(const int cols, const int rows, const int tile_cols, global const float *transfer,
                             global const float4 *observed, global float *partial) {
    local float samples[TILE_SAMPLES][COLUMNS + 1];
    const int item = get_local_id(0);
    const int tile = get_group_id(0);
    const int col = (tile % tile_cols) * TILE + item % TILE;
    const int row = (tile / tile_cols) * TILE + item / TILE;
    const int inside = col < cols && row < rows;
    const int sample = inside ? row * cols + col : 0;
    const float4 seen = inside ? observed[sample] : (float4)(0.0f);
    for (int i = 0; i < COEFFICIENTS; i++) samples[item][i] = seen.w > 0.0f ? transfer[sample * COEFFICIENTS + i] : 0.0f;
    samples[item][COEFFICIENTS] = seen.x;
    samples[item][COEFFICIENTS + 1] = seen.y;
    samples[item][COEFFICIENTS + 2] = seen.z;
    samples[item][COLUMNS] = seen.w;
    barrier(CLK_LOCAL_MEM_FENCE);

    const int entries = COLUMNS * (COLUMNS + 1) / 2;
    global float *out = partial + tile * (entries + 2);
    int entry = 0;
    for (int a = 0; a < COLUMNS; a++) {
        for (int b = a; b < COLUMNS; b++, entry++) {
            if (entry % TILE_SAMPLES != item) continue;
            float sum = 0.0f;
            for (int k = 0; k < TILE_SAMPLES; k++) sum += samples[k][COLUMNS] * samples[k][a] * samples[k][b];
            out[entry] = sum;
        }
    }
    if (item == 0) {
        float weight = 0.0f;
        float used = 0.0f;
        for (int k = 0; k < TILE_SAMPLES; k++) {
            weight += samples[k][COLUMNS];
            used += samples[k][COLUMNS] > 0.0f ? 1.0f : 0.0f;
        }
        out[entries] = weight;
        out[entries + 1] = used;
    }
}
