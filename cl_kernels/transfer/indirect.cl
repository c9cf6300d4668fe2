// What surfaces send to a sample has been photographed: the colour that the volume holds where a hidden direction ends.
// Provides gather_hits.
#include "surface_color.clh"
#include "visibility.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif

// One item a sample. It follows every `every`-th of its hidden directions, beginning with another one than its neighbours do.
// positions, normals [h][w]; free_mask [rows][cols][MASK_WORDS], sets [rows][cols][INTERLEAVE] (see Transfer); directions
// [256][count] (unit, sr); colors: of the volume
// -> hits [rows][cols]: sum over them of radiance times cosine, and of cosine (w), where the surface met has a colour; both
// times `every`.
kernel void gather_hits(const int cols, const int rows, const int stride, const int width, global const float4 *positions,
                        global const float4 *normals, global const uint *free_mask, global const uchar *sets,
                        VOLUME_PARAMETERS, global const uint *colors, const int count, global const float4 *directions, const float reach_m,
                        const int every, const float least_cosine, global float4 *hits) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int sample = row * cols + col;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 position = positions[pixel], normal = normals[pixel];
    const Volume volume = VOLUME_OF_PARAMETERS;
    float4 sum = (float4)(0.0f);
    if (position.w > 0.0f && normal.w > 0.0f) {
        const float3 origin_m = position.xyz + shape.voxel_m * normal.xyz;
        int chosen[LANES];
        int waiting = 0, met = (col + 2 * row) % every;
        for (int j = 0; j < count; j++) {
            const int from = sets[sample * INTERLEAVE + j % INTERLEAVE] * count + j;
            const int hidden = dot(normal.xyz, directions[from].xyz) >= least_cosine &&
                               !((free_mask[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1);
            if (hidden && met++ % every == 0) chosen[waiting++] = from;
            if (waiting == 0 || (waiting < LANES && j < count - 1)) continue;
            for (int lane = waiting; lane < LANES; lane++) chosen[lane] = chosen[0];
            const Rays rays = volume_rays(volume, origin_m, directions, chosen);
            floatn begin, end;
            clip_rays(volume, rays, &begin, &end);
            end = fmin(end, reach_m / shape.voxel_m);
            const floatn t = find_solid_voxels(volume, rays, begin, end);
            float distance[LANES];
            STORE_LANES(t < end ? t : -1.0f, distance);
            for (int lane = 0; lane < waiting; lane++) {
                if (distance[lane] < 0.0f) continue;
                const float3 direction = directions[chosen[lane]].xyz;
                const float4 color = color_at(volume, colors, origin_m / shape.voxel_m + distance[lane] * direction);
                sum += color.w * dot(normal.xyz, direction) * (float4)(color.xyz, 1.0f);
            }
            waiting = 0;
        }
    }
    hits[sample] = (float)every * sum;
}
