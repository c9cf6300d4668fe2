// Depth views of virtual objects from all around, for image-space shading (thesis 7.3.2). Provides draw_object.
#include "views.clh"
#include "virtual_objects.clh"

// A texel's half: how far along the grid's diagonal.
static inline uint texel_half(const float along, const float half_diagonal) {
    return 1u + (uint)(clamp(0.5f * along / half_diagonal + 0.5f, 0.0f, 1.0f) * TEXEL_STEPS + 0.5f);
}

// All views of one object, drawn from its distance grid [z][y][x] with `dims` cells (see virtual_objects.clh), one item a
// pixel. axes [views][3]: right, down and ahead of each, the grid's axes. -> texels of `slot`: see ObjectViews.
kernel void draw_object(const int4 dims, global const float *distances, global const float4 *axes, const int slot, global uint *texels) {
    const int x = get_global_id(0), y = get_global_id(1), view = get_global_id(2);
    if (x >= VIEW_PX || y >= VIEW_PX || view >= VIEW_CELLS * VIEW_CELLS) return;
    const float16 same = (float16)(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
    const float3 half_box = 0.5f * convert_float3(dims.xyz);
    const float half_diagonal = length(half_box), reach = 2.0f * half_diagonal;
    const float3 right = axes[3 * view].xyz, down = axes[3 * view + 1].xyz, ahead = axes[3 * view + 2].xyz;
    const float u = ((x + 0.5f) * (2.0f / VIEW_PX) - 1.0f) * dot(fabs(right), half_box);
    const float v = ((y + 0.5f) * (2.0f / VIEW_PX) - 1.0f) * dot(fabs(down), half_box);
    const float3 middle = half_box + u * right + v * down;
    const float first = distance_to_object(same, dims, distances, middle - half_diagonal * ahead, ahead, reach);
    uint texel = 0;
    if (first < reach) {
        const float last = distance_to_object(same, dims, distances, middle + half_diagonal * ahead, -ahead, reach);
        texel = texel_half(first - half_diagonal, half_diagonal) | texel_half(half_diagonal - last, half_diagonal) << 16;
    }
    texels[(slot * VIEW_CELLS * VIEW_CELLS + view) * VIEW_TEXELS + y * VIEW_PX + x] = texel;
}
