// Differences of a frame from the mean of earlier frames of a still camera.
// Provides compare_codes, average_codes.
//
// Both work on the received codes: [height][width][CHANNELS] of uint8 or uint16 (WIDE), where depth has two invalid values.
#ifndef CHANNELS
#error CHANNELS must be defined: the numbers of a pixel
#endif
#ifdef WIDE
typedef ushort code_t;
#else
typedef uchar code_t;
#endif

#define TILE 8
#define NONE_LEAST 0       // invalid depth values: nothing was measured
#define NONE_MOST 65535

static inline int is_known(const float value) {
    return CHANNELS > 1 || (value > NONE_LEAST && value < NONE_MOST);
}

// mean [height][width][CHANNELS]: of the frames before, 0 where depth is unknown. A work-item has a tile of TILE x TILE pixels.
// -> sums [tile_rows][tile_cols]: of codes minus their mean, of the squares of these differences, their number, and the number of
// pixels that are valid in only one of the two.
kernel void compare_codes(const int width, const int height, const int tile_cols, const int tile_rows, global const code_t *codes,
                          global const float *mean, global float4 *sums) {
    const int tile_col = get_global_id(0);
    const int tile_row = get_global_id(1);
    if (tile_col >= tile_cols || tile_row >= tile_rows) return;
    const int bottom = min(height, (tile_row + 1) * TILE), right = min(width, (tile_col + 1) * TILE);
    float sum = 0.0f, squares = 0.0f, known = 0.0f, flipped = 0.0f;
    for (int y = tile_row * TILE; y < bottom; y++) {
        const int end = (y * width + right) * CHANNELS;
        for (int i = (y * width + tile_col * TILE) * CHANNELS; i < end; i++) {
            const float now = codes[i], before = mean[i];
            const int in_now = is_known(now), in_mean = is_known(before);
            const float both = in_now && in_mean ? 1.0f : 0.0f;
            const float difference = both * (now - before);
            sum += difference;
            squares += difference * difference;
            known += both;
            flipped += in_now != in_mean ? 1.0f : 0.0f;
        }
    }
    sums[tile_row * tile_cols + tile_col] = (float4)(sum, squares, known, flipped);
}

// Fold codes [count] into their running mean as the `frames`-th; a value that is valid for the first time is copied.
kernel void average_codes(const int count, const int frames, global const code_t *codes, global float *mean) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const float now = codes[i], before = mean[i];
    if (!is_known(now)) return;
    mean[i] = frames > 1 && is_known(before) ? before + (now - before) / frames : now;
}
