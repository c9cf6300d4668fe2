// What a picture shows of patches of surface: means over blocks of pixels that lie on one surface. Provides gather_patches.

#define LABEL_STATIC 1
#define LEAST_AGREEMENT 0.9f  // cosine between normals of one surface
#define LEAST_CLIPPED 0.5f    // radiance above which a pixel that is not usable is clipped, not black
#define DARKEST 0.002f        // radiance below which a logarithm says nothing: a code or two of 8-bit sRGB

#define ALL_CLIPPED 0.9f      // of the strongest channel that the weakest has where all are clipped: others are lit surface
#define CLIPPED_DEPTH_M 0.15f // clipped surface this far behind the nearest of a block is something else

// Means over the clipped pixels of a block whose surface is nearest. eye, forward: of the camera, volume metres and unit; per_pixel:
// 1 / (fx fy). -> their position (xyz) and area across the line of sight in m^2 (w; 0: there is none); normal, shorter than 1 where they
// differ; radiance.
static void gather_clipped(const int row, const int col, const int step, const int width, const float3 eye, const float3 forward,
                           const float per_pixel, global const float4 *positions, global const float4 *normals, global const uchar *labels,
                           global const float4 *radiance, float4 *place, float4 *facing, float4 *shown) {
    float3 at = (float3)(0.0f), towards = (float3)(0.0f), sent = (float3)(0.0f);
    float area = 0.0f, nearest = INFINITY;
    for (int pass = 0; pass < 2; pass++) {
        for (int y = row * step; y < (row + 1) * step; y++) {
            for (int x = col * step; x < (col + 1) * step; x++) {
                const int pixel = y * width + x;
                const float4 position = positions[pixel], seen = radiance[pixel];
                if (position.w <= 0.0f || labels[pixel] != LABEL_STATIC || seen.w > 0.0f || seen.w <= -1.0f) continue;
                const float most = fmax(fmax(seen.x, seen.y), seen.z);
                if (most <= LEAST_CLIPPED || fmin(fmin(seen.x, seen.y), seen.z) < ALL_CLIPPED * most) continue;
                const float away = distance(position.xyz, eye);
                if (pass == 0) {
                    nearest = fmin(nearest, away);
                } else if (away <= nearest + CLIPPED_DEPTH_M) {
                    const float depth = dot(position.xyz - eye, forward);
                    const float part = per_pixel * depth * depth * depth / away;  // solid angle of a pixel: per_pixel (depth / away)^3
                    area += part;
                    at += part * position.xyz;
                    sent += part * seen.xyz;
                    towards += normals[pixel].w > 0.0f ? part * normals[pixel].xyz : (float3)(0.0f);
                }
            }
        }
    }
    const float scale = area > 0.0f ? 1.0f / area : 0.0f;
    *place = (float4)(scale * at, area);
    *facing = (float4)(scale * towards, 0.0f);
    *shown = (float4)(scale * sent, 0.0f);
}

// One item a block of step x step pixels. The surface is that of the block's middle pixel: static, a plane to within tolerance_m.
// positions, normals [h][w]; labels [h][w]; radiance [h][w] (w > 0 usable, -1 outside the picture)
// -> seen_patches [6][rows][cols], first the middle's position and the share of the block on its surface, 0 where there is none;
// then the mean unit normal, and the share of those pixels that are clipped;
// then the mean logarithm of radiance over usable pixels (where most are clipped, over those) and the variance of
// its mean over the channels; then the three of gather_clipped, whatever surface they are of.
kernel void gather_patches(const int cols, const int rows, const int step, const int width, const float tolerance_m,
                           const float4 eye, const float4 forward, const float per_pixel, global const float4 *positions,
                           global const float4 *normals, global const uchar *labels,
                           global const float4 *radiance, global float4 *seen_patches) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int block = row * cols + col;
    const int middle = (row * step + step / 2) * width + col * step + step / 2;
    const float4 position = positions[middle], normal = normals[middle];
    global float4 *place = seen_patches + block, *facing = place + rows * cols, *shown = facing + rows * cols;
    *place = *facing = *shown = (float4)(0.0f);
    float4 bright[3];
    gather_clipped(row, col, step, width, eye.xyz, forward.xyz, per_pixel, positions, normals, labels, radiance, bright, bright + 1,
                   bright + 2);
    for (int plane = 0; plane < 3; plane++) seen_patches[(3 + plane) * rows * cols + block] = bright[plane];
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
