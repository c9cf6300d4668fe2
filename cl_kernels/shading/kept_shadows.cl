// Provides begin_shadows, keep_shadows.
#include "kept_shadows.clh"

// An empty table. One item a place.
kernel void begin_shadows(const int places, global uint *table) {
    const int place = get_global_id(0);
    if (place >= places) return;
    vstore4((uint4)(0u, 0u, 0u, UINT_MAX), 0, shadow_entry(table, place));
    vstore4((uint4)(0u), 1, shadow_entry(table, place));
}

// What samples found who asked to fill a cell, those `around` (x0 y0 x1 y1, half-open) of [rows][cols], is kept there.
kernel void keep_shadows(const Grid grid, const int4 around, SHADOW_CELLS, global const int4 *asked, global const float4 *found) {
    const int col = around.x + get_global_id(0);
    const int row = around.y + get_global_id(1);
    if (col >= around.z || row >= around.w) return;
    const int sample = row * grid.cols + col;
    keep_shadow(cells, asked[sample], found[sample].xyz, table);
}
