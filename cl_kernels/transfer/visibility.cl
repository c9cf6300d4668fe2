// Visibility of the sky from samples of a surface (thesis 5.1.2), without transfer. Provides trace_visibility.
#include "direction_sets.clh"
#include "hemisphere.clh"

// One item a sample; samples lie every `stride` pixels from stride / 2. positions, normals [h][w]: the geometry buffer.
// directions [256][count]: unit directions, see direction_sets.clh. -> free, blocked [rows][cols][MASK_WORDS]: bit j: direction j
// lies above the surface, and is free for `ray_length_m` or is not; zeros where there is no surface.
kernel void trace_visibility(const int cols, const int rows, const int stride, const int width,
                             global const float4 *positions, global const float4 *normals, VOLUME_PARAMETERS, const int count,
                             global const float4 *directions, const float ray_length_m,
                             global uint *free, global uint *blocked) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= cols || row >= rows) return;
    const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
    const float4 position = positions[pixel], normal = normals[pixel];
    const Volume volume = VOLUME_OF_PARAMETERS;
    uint asked[MASK_WORDS], is_free[MASK_WORDS], is_blocked[MASK_WORDS];
    for (int i = 0; i < MASK_WORDS; i++) {
        asked[i] = 0xFFFFFFFFu;
        is_free[i] = is_blocked[i] = 0;
    }
    global const float4 *own = directions + direction_set(row, col) * count;
    if (position.w > 0.0f && normal.w > 0.0f)
        trace_hemisphere(volume, position.xyz + shape.voxel_m * normal.xyz, normal.xyz, own, count, ray_length_m, asked, is_free, is_blocked);
    const int first = (row * cols + col) * MASK_WORDS;
    for (int i = 0; i < MASK_WORDS; i++) {
        free[first + i] = is_free[i];
        blocked[first + i] = is_blocked[i];
    }
}
