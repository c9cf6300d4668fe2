// A mesh's occupancy grid and distance grid, once on load (the volumes of thesis 7.2, fig. 7.5).
//
// clear_cells -> mark_cells, measure_near; seed_distance (x) -> spread_distance (y) -> spread_distance (z); finish.
// Near the mesh the distance is measured to its triangles, so that parts thinner than a cell keep their position in it;
// farther away it is the distance to the nearest touched cell, by an exact Euclidean distance transform.
// Grids are [z, y, x] int32 or float32; cell (x, y, z) is the cube from (x, y, z) to (x + 1, y + 1, z + 1) grid units.
#include "camera.clh"

#ifndef SLAB
#error "SLAB: cells in z that one work-item of mark_cells and measure_near looks at"
#endif

#define NONE (1 << 28)  // squared distance where no cell is occupied; sums of it with a squared grid side fit an int

constant float HALF_CELL = 0.5001f;  // touching counts: more than rounding, less than matters
constant float NEAR_CELLS = 1.65f;   // up to this distance from cells' centres it is measured to triangles

// False if the projections on `axis` of a triangle and of a cell around the origin are apart. Any axis is valid:
// only a true gap separates, so an axis rotated by rounding costs tightness, never a cell.
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

// Separating-axis test of a triangle and a cell around the origin, without the cell's own axes, which the bounds cover.
static bool overlaps_cell(const float3 a, const float3 b, const float3 c) {
    return overlaps_along(cross(b - a, c - a), a, b, c) && overlaps_beside(b - a, a, b, c)
           && overlaps_beside(c - b, a, b, c) && overlaps_beside(a - c, a, b, c);
}

static inline int cell_index(const int4 dims, const int x, const int y, const int z) {
    return (z * dims.y + y) * dims.x + x;
}

// Last cell of a slab.
static inline int3 high_corner(const int4 dims, const int slab) {
    return (int3)(dims.x, dims.y, min(slab + SLAB, dims.z)) - 1;
}

kernel void clear_cells(const int cells, global int *occupied, global int *near) {
    const int cell = get_global_id(0);
    if (cell >= cells) return;
    occupied[cell] = 0;
    near[cell] = as_int(2.0f * NEAR_CELLS);
}

// Marks the cells that a triangle touches, in one slab of the grid: a large triangle is split over all slabs.
// dims: cells in x, y, z.
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
    const int3 high = min(convert_int3_rtn(fmax(a, fmax(b, c)) + rim), high_corner(dims, slab));
    for (int z = low.z; z <= high.z; z++)
        for (int y = low.y; y <= high.y; y++)
            for (int x = low.x; x <= high.x; x++) {
                const float3 center = (float3)(x, y, z) + 0.5f;
                if (!overlaps_cell(a - center, b - center, c - center)) continue;
                atomic_or(&occupied[cell_index(dims, x, y, z)], 1);
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

// Extends squared distances by one axis: minimum over the line of each value plus its squared distance along the line.
// Searches outwards until no farther cell can be nearer. `length`: cells of the line; `stride`: from one of them to the next.
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

static inline float squared_length(const float3 v) { return dot(v, v); }

// Squared distance from the origin to the line from a to a + ab.
static inline float squared_to_edge(const float3 a, const float3 ab) {
    const float along = -dot(a, ab) / fmax(squared_length(ab), 1e-20f);
    return squared_length(a + clamp(along, 0.0f, 1.0f) * ab);
}

// The normal of a sliver is only rounding error; its edges are as near as its inside.
static inline bool is_sliver(const float3 normal, const float3 ab, const float3 ca) {
    return squared_length(normal) <= 1e-8f * squared_length(ab) * squared_length(ca);
}

// Squared distance from the origin to a triangle: to its inside if the origin projects into it, else to its edges.
static float squared_to_triangle(const float3 a, const float3 b, const float3 c) {
    const float3 ab = b - a, bc = c - b, ca = a - c, normal = cross(ab, -ca);
    const float best = fmin(squared_to_edge(a, ab), fmin(squared_to_edge(b, bc), squared_to_edge(c, ca)));
    const bool is_above = dot(cross(normal, ab), a) <= 0.0f && dot(cross(normal, bc), b) <= 0.0f
                          && dot(cross(normal, ca), c) <= 0.0f;
    if (!is_above || is_sliver(normal, ab, ca)) return best;
    const float height = dot(normal, a) / length(normal);
    return fmin(best, height * height);
}

// Lowers `near` (bits of float cells; they order as the floats do) to the distance of a triangle from the centres of
// the cells around it, in one slab of the grid.
kernel void measure_near(const int triangle_count, const int4 dims, const global float *vertices,
                         const global int *triangles, const float16 grid_from_model, global int *near) {
    const int triangle = get_global_id(0), slab = SLAB * get_global_id(1);
    if (triangle >= triangle_count || slab >= dims.z) return;
    const int3 v = vload3(triangle, triangles);
    const float3 a = transform_point(grid_from_model, vload3(v.x, vertices));
    const float3 b = transform_point(grid_from_model, vload3(v.y, vertices));
    const float3 c = transform_point(grid_from_model, vload3(v.z, vertices));
    const float3 normal = cross(b - a, c - a);
    const float reach = is_sliver(normal, b - a, a - c) ? MAXFLOAT : 1.01f * NEAR_CELLS * length(normal);
    const int3 low = max(convert_int3_rtp(fmin(a, fmin(b, c)) - NEAR_CELLS - 0.5f), (int3)(0, 0, slab));
    const int3 high = min(convert_int3_rtn(fmax(a, fmax(b, c)) + NEAR_CELLS - 0.5f), high_corner(dims, slab));
    for (int z = low.z; z <= high.z; z++)
        for (int y = low.y; y <= high.y; y++)
            for (int x = low.x; x <= high.x; x++) {
                const float3 center = (float3)(x, y, z) + 0.5f;
                if (fabs(dot(normal, a - center)) > reach) continue;
                const float cells = sqrt(squared_to_triangle(a - center, b - center, c - center));
                if (cells < NEAR_CELLS) atomic_min(&near[cell_index(dims, x, y, z)], as_int(cells));
            }
}

// The measured distance if there is one, else the distance to the nearest touched cell.
kernel void finish_distance(const int cells, const global int *squared, const global int *near,
                            global float *distance) {
    const int cell = get_global_id(0);
    if (cell >= cells) return;
    const float measured = as_float(near[cell]);
    distance[cell] = measured < NEAR_CELLS ? measured : fmax(sqrt((float)squared[cell]), NEAR_CELLS);
}
