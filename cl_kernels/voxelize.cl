// A mesh's occupancy grid and its distance transform, once on load (the volumes of thesis 7.2, fig. 7.5).
//
// mark_cells -> seed_distance (x) -> spread_distance (y) -> spread_distance (z) -> finish_distance.
// Grids are [z, y, x] int32 or float32; cell (x, y, z) is the cube from (x, y, z) to (x + 1, y + 1, z + 1) grid units.
#include "camera.clh"

#ifndef SLAB
#error "SLAB: cells in z that one work-item of mark_cells looks at"
#endif

#define NONE (1 << 28)  // squared distance where no cell is occupied; sums of it with a squared grid side fit an int

constant float HALF_CELL = 0.5001f;  // touching counts: more than rounding, less than matters

// False if the projections on `axis` of a triangle and of a cell around the origin are apart. Any axis may be asked:
// only a true gap separates, so an axis that rounding has turned costs tightness, never a cell.
static inline bool overlaps_along(const float3 axis, const float3 a, const float3 b, const float3 c) {
    const float reach = HALF_CELL * (fabs(axis.x) + fabs(axis.y) + fabs(axis.z));
    const float pa = dot(axis, a), pb = dot(axis, b), pc = dot(axis, c);
    return fmax(pa, fmax(pb, pc)) >= -reach && fmin(pa, fmin(pb, pc)) <= reach;
}

// The axes that an edge makes with those of the cell.
static inline bool overlaps_beside(const float3 edge, const float3 a, const float3 b, const float3 c) {
    return overlaps_along((float3)(0.0f, -edge.z, edge.y), a, b, c)
           && overlaps_along((float3)(edge.z, 0.0f, -edge.x), a, b, c)
           && overlaps_along((float3)(-edge.y, edge.x, 0.0f), a, b, c);
}

// Separating-axis test of a triangle and a cell around the origin, less the cell's own axes: bounds are compared before.
static bool overlaps_cell(const float3 a, const float3 b, const float3 c) {
    return overlaps_along(cross(b - a, c - a), a, b, c) && overlaps_beside(b - a, a, b, c)
           && overlaps_beside(c - b, a, b, c) && overlaps_beside(a - c, a, b, c);
}

// Marks the cells that a triangle touches, in one slab of the grid: a large triangle is shared out over all slabs.
// `occupied` starts as 0. dims: cells in x, y, z.
kernel void mark_cells(const int triangle_count, const int4 dims, const global float *vertices,
                       const global int *triangles, const float16 grid_from_model, global int *occupied) {
    const int triangle = get_global_id(0), slab = SLAB * get_global_id(1);
    if (triangle >= triangle_count || slab >= dims.z) return;
    const int3 v = vload3(triangle, triangles);
    const float3 a = transform_point(grid_from_model, vload3(v.x, vertices));
    const float3 b = transform_point(grid_from_model, vload3(v.y, vertices));
    const float3 c = transform_point(grid_from_model, vload3(v.z, vertices));
    const float rim = HALF_CELL - 0.5f;
    const int3 low = max(convert_int3_rtn(fmin(a, fmin(b, c)) - rim), (int3)(0, 0, slab));
    const int3 high = min(convert_int3_rtn(fmax(a, fmax(b, c)) + rim), (int3)(dims.x, dims.y, min(slab + SLAB, dims.z)) - 1);
    for (int z = low.z; z <= high.z; z++)
        for (int y = low.y; y <= high.y; y++)
            for (int x = low.x; x <= high.x; x++) {
                const float3 center = (float3)(x, y, z) + 0.5f;
                if (overlaps_cell(a - center, b - center, c - center)) atomic_or(&occupied[(z * dims.y + y) * dims.x + x], 1);
            }
}

// Squared distance, in cells, to the nearest occupied cell of the same row; one work-item a row.
kernel void seed_distance(const int4 dims, const global int *occupied, global int *squared) {
    const int row = get_global_id(0);
    if (row >= dims.y * dims.z) return;
    const global int *cells = occupied + row * dims.x;
    global int *result = squared + row * dims.x;
    int gap = -1;  // cells since an occupied one, -1 before the first
    for (int x = 0; x < dims.x; x++) {
        gap = cells[x] ? 0 : gap < 0 ? -1 : gap + 1;
        result[x] = gap < 0 ? NONE : gap * gap;
    }
    gap = -1;
    for (int x = dims.x - 1; x >= 0; x--) {
        gap = cells[x] ? 0 : gap < 0 ? -1 : gap + 1;
        if (gap >= 0) result[x] = min(result[x], gap * gap);
    }
}

// Extends squared distances by one axis: min over the line of what is there plus the squared way along it. Looks outwards
// until nothing farther can be nearer. `length`: cells of the line; `stride`: from one of its cells to the next.
kernel void spread_distance(const int cells, const int length, const int stride, const global int *squared,
                            global int *result) {
    const int cell = get_global_id(0);
    if (cell >= cells) return;
    const int at = cell / stride % length;
    int best = squared[cell];
    for (int r = 1; r < length && r * r < best; r++) {
        if (r <= at) best = min(best, squared[cell - r * stride] + r * r);
        if (r < length - at) best = min(best, squared[cell + r * stride] + r * r);
    }
    result[cell] = best;
}

kernel void finish_distance(const int cells, const global int *squared, global float *distance) {
    const int cell = get_global_id(0);
    if (cell < cells) distance[cell] = sqrt((float)squared[cell]);
}
