// The volume's colours as seen by a camera, for viewers without a camera of their own. Provides view_colors.
#include "volume.clh"
#include "voxel_color.clh"

// positions [h][w] (volume space, w = 1: surface) -> radiance [h][w]: trilinear mean of those of the eight voxels around each
// point that have a colour (rgb, w = 1), or 0 if none has one.
kernel void view_colors(const int width, const int height, const int4 bricks, global const int *slots, global const uint *colors,
                        const float voxel_m, global const float4 *positions, global float4 *radiance) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const float4 position = positions[y * width + x];
    float4 sum = (float4)(0.0f);
    if (position.w > 0.0f) {
        const float3 at = position.xyz / voxel_m - 0.5f;  // in voxels, measured from the centre of the first
        const float3 low = floor(at);
        const int3 top = bricks.xyz * BRICK - 1;
        for (int corner = 0; corner < 8; corner++) {
            const int3 step = (int3)(corner & 1, (corner >> 1) & 1, corner >> 2);
            const float3 near = 1.0f - fabs(low + convert_float3(step) - at);
            const int3 voxel = clamp(convert_int3(low) + step, (int3)(0), top);
            const int slot = slots[brick_index(bricks, voxel >> 3)];
            if (slot <= AWAY_SLOT) continue;
            const float4 color = unpack_color(colors[slot * BRICK_VOXELS + ((voxel.z & 7) * BRICK + (voxel.y & 7)) * BRICK + (voxel.x & 7)]);
            if (color.w > 0.0f) sum += near.x * near.y * near.z * (float4)(color.xyz, 1.0f);
        }
    }
    radiance[y * width + x] = sum.w > 0.0f ? (float4)(sum.xyz / sum.w, 1.0f) : (float4)(0.0f);
}
