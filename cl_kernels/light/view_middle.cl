// The middle of the surface that a picture sees. Provides sum_positions.

// One item a sampled row: the sum of the surface's positions at every `step`-th pixel, from left to right. The host adds
// the rows, so the order is fixed.
// positions [h][w]: volume metres, w = 1 where there is surface, else 0 -> sums [rows]: xyz metres, w their number.
kernel void sum_positions(const int width, const int rows, const int step, global const float4 *positions,
                          global float4 *sums) {
    const int row = get_global_id(0);
    if (row >= rows) return;
    global const float4 *line = positions + (step / 2 + row * step) * width;
    float4 sum = (float4)(0.0f);
    for (int column = step / 2; column < width; column += step) {
        const float4 here = line[column];
        if (here.w > 0.0f) sum += (float4)(here.xyz, 1.0f);
    }
    sums[row] = sum;
}
