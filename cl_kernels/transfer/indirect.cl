// Indirect light from photographed surfaces: the colour in the volume where a blocked direction of a sample ends.
// Provides gather_hits.
#include "meeting.clh"
#include "met.clh"
#include "samples.clh"
#include "surface_color.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif

// One item a sample. It traces every `every`-th of its blocked directions; neighbours begin with different ones.
// positions, normals [h][w]; free_mask [rows][cols][MASK_WORDS], sets [rows][cols][INTERLEAVE] (see Transfer); directions
// [256][count] (unit, sr); colors: of the volume
// -> hits [rows][cols]: sums of radiance times cosine and of cosine (w) over directions whose surface has a colour; both times
// `every`; met [rows][cols][most]: the directions that meet surface, and how far away (met.clh). With HAS_CACHE samples that are `found`
// (transfer_cache.cl) keep their values.
kernel void gather_hits(const GatherParameters p, global const float4 *positions, global const float4 *normals,
                        global const uint *free_mask, global const uchar *sets, global const int *slots,
                        global const ulong *solid, global const uchar *octets, global const float2 *voxels,
                        global const uint *colors, global const float4 *directions, global float4 *hits, global uint *met
#ifdef HAS_CACHE
                        , global const int *found
#endif
) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
#ifdef HAS_CACHE
    if (found[sample] >= 0) return;
#endif
    const int count = p.count, every = p.every;
    const float4 position = positions[pixel], normal = normals[pixel];
    const Volume volume = make_volume(p.volume, slots, solid, octets, voxels);
    float4 sum = (float4)(0.0f);
    int count_met = 0;
    if (position.w > 0.0f && normal.w > 0.0f) {
        const float3 origin_m = position.xyz + volume.voxel_m * normal.xyz;
        int chosen[LANES], number[LANES];
        int waiting = 0, hidden_ones = (col + 2 * row) % every;
        for (int j = 0; j < count; j++) {
            const int from = sets[sample * INTERLEAVE + j % INTERLEAVE] * count + j;
            const int hidden = dot(normal.xyz, directions[from].xyz) >= p.least_cosine &&
                               !((free_mask[sample * MASK_WORDS + (j >> 5)] >> (j & 31)) & 1);
            if (hidden && hidden_ones++ % every == 0) {
                number[waiting] = j;
                chosen[waiting++] = from;
            }
            if (waiting == 0 || (waiting < LANES && j < count - 1)) continue;
            for (int lane = waiting; lane < LANES; lane++) chosen[lane] = chosen[0];
            float distance_m[LANES];
            meet(volume, origin_m, directions, chosen, p.ray_length_m, distance_m);
            for (int lane = 0; lane < waiting; lane++) {
                if (distance_m[lane] < 0.0f) continue;
                met[sample * p.most + count_met++] = pack_met(number[lane], distance_m[lane]);
                const float3 direction = directions[chosen[lane]].xyz;
                const float4 color = color_at(volume, colors, (origin_m + distance_m[lane] * direction) / volume.voxel_m);
                if (color.w > 0.0f) sum += dot(normal.xyz, direction) * (float4)(color.xyz, 1.0f);
            }
            waiting = 0;
        }
    }
    hits[sample] = (float)every * sum;
    if (count_met < p.most) met[sample * p.most + count_met] = NO_MORE_MET;
}
