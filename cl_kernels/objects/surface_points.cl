// Points on a virtual object's surface, distributed once on load (objects/surface_points.py). Provides count_open.
#include "virtual_objects.clh"

// For each point, how many of `directions` [count] above the surface leave the object (grid of `dims` cells) unblocked, from
// one cell off the point. points, normals [points_count] in cells and along the axes of the grid.
kernel void count_open(const int points_count, global const float4 *points, global const float4 *normals, const int count,
                       global const float4 *directions, const int4 dims, global const float *distances, global int *open) {
    const int index = get_global_id(0);
    if (index >= points_count) return;
    const float16 same = (float16)(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
    const float3 normal = normals[index].xyz, origin = points[index].xyz + normal;
    const float reach = (float)(dims.x + dims.y + dims.z);
    int sum = 0;
    for (int j = 0; j < count; j++) {
        const float3 direction = directions[j].xyz;
        if (dot(normal, direction) > 0.0f) sum += distance_to_object(same, dims, distances, origin, direction, reach) >= reach;
    }
    open[index] = sum;
}
