// What a picture shows of patches of surface: means over blocks of pixels that lie on one surface. Provides gather_patches.

#define LABEL_STATIC 1
#define LEAST_AGREEMENT 0.9f  // cosine between normals of one surface
#define LEAST_CLIPPED 0.5f    // radiance above which a pixel that is not usable is clipped, not black
#define DARKEST 0.002f        // radiance below which a logarithm says nothing: a code or two of 8-bit sRGB

// One item a block of step x step pixels. The surface is that of the block's middle pixel: static, a plane to within tolerance_m.
// positions, normals [h][w]; labels [h][w]; radiance [h][w] (w > 0 usable, -1 outside the picture)
// -> seen_patches [3][rows][cols], first the middle's position and the share of the block on its surface, 0 where there is none;
// then the mean unit normal, and the share of those pixels that are clipped;
// then the mean logarithm of radiance over usable pixels (where most are clipped, over those) and the variance of
// its mean over the channels.
kernel void gather_patches(const int cols, const int rows, const int step, const int width, const float tolerance_m,
                           global const float4 *positions, global const float4 *normals, global const uchar *labels,
                           global const float4 *radiance, global float4 *seen_patches) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int block = row * cols + col;
    const int middle = (row * step + step / 2) * width + col * step + step / 2;
    const float4 position = positions[middle], normal = normals[middle];
    global float4 *place = seen_patches + block, *facing = place + rows * cols, *shown = facing + rows * cols;
    *place = *facing = *shown = (float4)(0.0f);
    if (position.w <= 0.0f || normal.w <= 0.0f || labels[middle] != LABEL_STATIC) return;
    float3 direction = (float3)(0.0f), usable = (float3)(0.0f), clipped = (float3)(0.0f);
    float squares = 0.0f;
    int on_surface = 0, usable_count = 0, clipped_count = 0;
    for (int y = row * step; y < (row + 1) * step; y++) {
        for (int x = col * step; x < (col + 1) * step; x++) {
            const int pixel = y * width + x;
            const float4 at = positions[pixel], towards = normals[pixel], seen = radiance[pixel];
            if (at.w <= 0.0f || labels[pixel] != LABEL_STATIC || seen.w <= -1.0f) continue;
            if (dot(towards.xyz, normal.xyz) < LEAST_AGREEMENT || fabs(dot(at.xyz - position.xyz, normal.xyz)) > tolerance_m) continue;
            const float3 logarithm = log(fmax(seen.xyz, DARKEST));
            on_surface++;
            direction += towards.xyz;
            if (seen.w > 0.0f) {
                const float mean = (logarithm.x + logarithm.y + logarithm.z) / 3.0f;
                usable += logarithm;
                squares += mean * mean;
                usable_count++;
            } else if (fmax(fmax(seen.x, seen.y), seen.z) > LEAST_CLIPPED) {
                clipped += logarithm;
                clipped_count++;
            }
        }
    }
    if (usable_count + clipped_count == 0) return;
    const int is_clipped = clipped_count > usable_count;
    const float3 mean = is_clipped ? clipped / clipped_count : usable / usable_count;
    const float level = (mean.x + mean.y + mean.z) / 3.0f;
    *place = (float4)(position.xyz, (float)on_surface / (step * step));
    *facing = (float4)(normalize(direction), (float)clipped_count / (usable_count + clipped_count));
    *shown = (float4)(mean, is_clipped ? 0.0f : fmax(squares / usable_count - level * level, 0.0f));
}
