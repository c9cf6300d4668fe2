// The pool of bricks: clearing, placing and copying. Slot 0 represents all bricks on the host, see server/volume/brick_pool.py.
// Provides claim_bricks, place_bricks, copy_bricks.
#include "volume.clh"

// slots [count] -> their voxels are never seen and without colour. One item a row of 8 voxels.
kernel void claim_bricks(const int count, global const int *slots, global float2 *voxels, global uint *colors) {
    const int item = get_global_id(0);
    if (item >= count * BRICK * BRICK) return;
    const int row = slots[item / (BRICK * BRICK)] * BRICK * BRICK + item % (BRICK * BRICK);
    vstore16((float16)(0.0f), row, (global float *)voxels);
    vstore8((uint8)(0), row, colors);
}

// bricks [count] and their new slots [count] -> table [z][y][x]; a brick with NO_SLOT is not solid.
kernel void place_bricks(const int count, global const int *bricks, global const int *slots, global int *table,
                         global ulong *solid) {
    const int item = get_global_id(0);
    if (item >= count) return;
    const int brick = bricks[item];
    table[brick] = slots[item];
    if (slots[item] == NO_SLOT) solid[brick] = 0;
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
