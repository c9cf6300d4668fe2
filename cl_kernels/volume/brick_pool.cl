// The pool of bricks: clearing, placing and copying. Slot 0 represents all bricks on the host, see server/volume/brick_pool.py.
// Provides place_bricks, copy_bricks, forget_colors.
#include "volume.clh"

// listed: the bricks [count] from `first` on, and their new slots [count] behind them -> table [z][y][x]; a brick with NO_SLOT is
// not solid; if `clears`, the slots' voxels are never seen and without colour. One item a row of 8 voxels.
kernel void place_bricks(const int count, const int clears, const int first, global const int *listed, global int *table,
                         global ulong *solid, global float2 *voxels, global uint *colors) {
    const int item = get_global_id(0);
    if (item >= count * BRICK * BRICK) return;
    const int row = item % (BRICK * BRICK), number = first + item / (BRICK * BRICK);
    const int brick = listed[number], slot = listed[number + count];
    if (row == 0) table[brick] = slot;
    if (row == 0 && slot == NO_SLOT) solid[brick] = 0;
    if (!clears) return;
    vstore16((float16)(0.0f), slot * BRICK * BRICK + row, (global float *)voxels);
    vstore8((uint8)(0), slot * BRICK * BRICK + row, colors);
}

// Rows `from` [count] of one pool -> rows `to` [count] of another. One item a row of 8 voxels.
kernel void copy_bricks(const int count, global const int *from, global const float2 *voxels_from, global const uint *colors_from,
                        global const int *to, global float2 *voxels_to, global uint *colors_to) {
    const int item = get_global_id(0);
    if (item >= count * BRICK * BRICK) return;
    const int brick = item / (BRICK * BRICK), row = item % (BRICK * BRICK);
    const int source = from[brick] * BRICK * BRICK + row, target = to[brick] * BRICK * BRICK + row;
    vstore16(vload16(source, (global const float *)voxels_from), target, (global float *)voxels_to);
    vstore8(vload8(source, colors_from), target, colors_to);
}

// colors [slots], see bricks.py: means keep the share `kept` of their weights, rounded. One item a row of 8 voxels.
kernel void forget_colors(const int slots, const float kept, global uint *colors) {
    const int row = get_global_id(0);
    if (row >= slots * BRICK * BRICK) return;
    const uint8 color = vload8(row, colors), weight = max(color & 63u, 1u) - 1u;
    const uint8 left = convert_uint8(convert_float8(weight) * kept + 0.5f);
    vstore8((color & ~63u) | select((uint8)(0), left + 1u, (color & 63u) > 0u), row, colors);
}
