// Light that arrives at points: which surface each direction meets first, and the radiance it sends. Provides trace_arrivals.
#include "clear_origin.clh"
#include "surface_color.clh"
#include "visibility.clh"

// Whether a ray meets the surface at voxel coordinates `at` from its back, which no camera saw.
static inline int is_back(const Volume volume, const float3 at, const float3 direction) {
    float distance_m;
    float3 outwards;
    return surface_near(volume, at * volume.voxel_m, &distance_m, &outwards) && dot(outwards, direction) > 0.0f;
}

// Where the rays of a point of scanned surface begin: as for a virtual surface (clear_origin.clh), but however deep its mean place lies.
static float3 clear_of_surface(const Volume volume, const float3 point, const float3 normal) {
    const float3 origin = point + volume.voxel_m * normal;
    float distance_m;
    float3 outwards;
    if (!surface_near(volume, origin, &distance_m, &outwards) || distance_m >= volume.voxel_m) return origin;
    return origin + (volume.voxel_m - distance_m) * outwards;
}

// One item LANES directions of a point. Groups of rays (opencl/structs.py), in the order of their items; of those that are not there
// first_item is more than any. A group's rows of `table`, one after the other: points [count], volume metres, w unused; normals [count] of
// the surface that a point lies on: rays begin clear of it and directions below its plane are skipped; w = 0: it lies on none;
// directions [sets][per_set] unit. Point i takes set i % sets.
// -> arrivals, group by group [count][per_set]: radiance (rgb) of the surface that is met, and its distance in metres (w): positive,
// surface that was photographed; negative, a back or surface without a colour (rgb 0), or one that only another light showed (rgb its colour
// then); 0, nothing is met, or the direction is skipped.
kernel void trace_arrivals(const VolumeShape shape, global const int *slots, global const ulong *solid,
                           global const uchar *octets, global const float2 *voxels, global const uint *colors,
                           const int items, const RayGroup first_group, const RayGroup second_group, const RayGroup third_group,
                           global const float4 *table, global float4 *arrivals) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const RayGroup group = item >= third_group.first_item ? third_group : item >= second_group.first_item ? second_group : first_group;
    const int per_point = (group.per_set + LANES - 1) / LANES;
    const int point = (item - group.first_item) / per_point;
    const int first = (item - group.first_item) % per_point * LANES;
    const Volume volume = make_volume(shape, slots, solid, octets, voxels);
    table += group.first_row;
    global const float4 *directions = table + 2 * group.count;
    const float4 place = table[point], normal = table[group.count + point];
    const int set = (point % group.sets) * group.per_set;
    int chosen[LANES], skipped = 0;
    for (int lane = 0; lane < LANES; lane++) {
        chosen[lane] = set + min(first + lane, group.per_set - 1);
        skipped |= (normal.w > 0.0f && dot(normal.xyz, directions[chosen[lane]].xyz) <= 0.0f) << lane;
    }
    const int asked = min(LANES, group.per_set - first);
    arrivals += group.first_arrival + point * group.per_set + first;
    if (skipped == (1 << LANES) - 1) {
        for (int lane = 0; lane < asked; lane++) arrivals[lane] = (float4)(0.0f);
        return;
    }
    const float3 origin = normal.w > 0.0f ? clear_of_surface(volume, place.xyz, normal.xyz) : place.xyz;
    const Rays rays = volume_rays(volume, origin, directions, chosen);
    floatn begin, end;
    clip_rays(volume, rays, &begin, &end);
    end = mask_of(skipped) ? begin : end;
    const floatn t = find_solid_voxels(volume, rays, begin, end);
    float met[LANES];
    STORE_LANES(t < end ? t : 0.0f, met);
    for (int lane = 0; lane < asked; lane++) {
        float4 arrival = (float4)(0.0f);
        if (met[lane] > 0.0f) {
            const float3 direction = directions[chosen[lane]].xyz;
            const float3 at = origin / volume.voxel_m + met[lane] * direction;
            float4 color = color_at(volume, colors, at);
            if (color.w <= 0.0f) color = color_at(volume, colors, at - direction);  // colours reach 1.5 voxels deep (integrate.cl)
            const int is_front = color.w > 0.0f && !is_back(volume, at, direction);
            const float distance_m = met[lane] * volume.voxel_m;
            arrival.xyz = is_front ? color.xyz : (float3)(0.0f);
            arrival.w = is_front && color.w > 1.0f ? distance_m : -distance_m;
        }
        arrivals[lane] = arrival;
    }
}
