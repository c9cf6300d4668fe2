// Tables of the brick volume: bricks near the measured surface, solid cells, and gaps between solid bricks.
// Provides mark_bricks, find_solid, find_near_solid, gaps_in_slices, gaps_along_z.
#include "camera.clh"
#include "groups.clh"
#include "volume.clh"

#define TILE 4

// Beyond this a point is outside any volume, and its brick index may overflow an int.
#define FAR_BRICKS 1e6f

static inline int floor_of(const float x) {
    const int truncated = (int)x;
    return truncated - (x < truncated);
}

// Frustum around one ray of the camera that contains a piece of the measured surface.
typedef struct {
    float3 origin;  // of the camera, in bricks
    float3 onward;  // along the ray, bricks a metre of depth
    float3 beside;  // half the frustum's width along the volume's axes, bricks a metre of depth
    float near;     // range of depths, metres
    float far;
} Frustum;

// marked [z][y][x] = 1 for every brick that the frustum touches: in slices of at most half a brick, the box around each slice.
static void mark_frustum(const int4 bricks, const Frustum piece, global uchar *marked) {
    const float span = piece.far - piece.near;
    const int steps = min((int)(2.0f * span * length(piece.onward)), 1000) + 1;
    const float3 step = span / steps * piece.onward;
    const float3 pad = 0.5f * fabs(step) + piece.far * piece.beside;
    const float3 first = piece.origin + piece.near * piece.onward + 0.5f * step;
    for (int i = 0; i < steps; i++) {
        const float3 p = first + (float)i * step;
        if (!(fabs(p.x) + fabs(p.y) + fabs(p.z) < FAR_BRICKS)) continue;
        const int low_x = max(floor_of(p.x - pad.x), 0), high_x = min(floor_of(p.x + pad.x), bricks.x - 1);
        const int low_y = max(floor_of(p.y - pad.y), 0), high_y = min(floor_of(p.y + pad.y), bricks.y - 1);
        const int low_z = max(floor_of(p.z - pad.z), 0), high_z = min(floor_of(p.z + pad.z), bricks.z - 1);
        for (int bz = low_z; bz <= high_z; bz++)
            for (int by = low_y; by <= high_y; by++)
                for (int bx = low_x; bx <= high_x; bx++) marked[(bz * bricks.y + by) * bricks.x + bx] = 1;  // all write 1
    }
}

// depth_m [h][w], 0 = none -> marked [z][y][x] = 1 for every brick with a voxel within `ray_length_m` of the measured surface
// along the ray, and a few more. One item a tile of TILE x TILE pixels; depths within half a brick are treated as one piece of
// surface.
kernel void mark_bricks(const int width, const int height, const int4 bricks, global const float *depth_m,
                        const float4 intrinsics, const float16 volume_from_camera, const float voxel_m, const float ray_length_m,
                        global uchar *marked) {
    const int x = get_global_id(0) * TILE;
    const int y = get_global_id(1) * TILE;
    if (x >= width || y >= height) return;
    float depth[TILE * TILE];
    float4 nearest = (float4)(MAXFLOAT);
    for (int row = 0; row < TILE; row++) {
        if (x + TILE <= width && y + row < height) {
            vstore4(vload4(0, depth_m + (y + row) * width + x), row, depth);
        } else {
            for (int i = 0; i < TILE; i++)
                depth[row * TILE + i] = x + i < width && y + row < height ? depth_m[(y + row) * width + x + i] : 0.0f;
        }
        const float4 four = vload4(row, depth);
        nearest = fmin(nearest, select((float4)(MAXFLOAT), four, four > 0.0f));
    }
    float near = fmin(fmin(nearest.x, nearest.y), fmin(nearest.z, nearest.w));
    if (near == MAXFLOAT) return;

    const float brick_m = BRICK * voxel_m;
    const float3 ray = unproject(intrinsics, x + 0.5f * (TILE - 1), y + 0.5f * (TILE - 1));
    // The tile's own voxels extend half a pixel beyond it; interpolation uses its depth up to one and a half pixels beyond.
    const float2 beside = (0.5f * TILE + 1.0f) / intrinsics.lo;
    const float least_slant = length(fmax(fabs(ray) - (float3)(beside, 0.0f), 0.0f));
    const float reach_z = ray_length_m / least_slant;
    Frustum piece;
    piece.origin = volume_from_camera.s37b / brick_m;
    piece.onward = transform_vector(volume_from_camera, ray) / brick_m;
    piece.beside = (fabs(volume_from_camera.s048) * beside.x + fabs(volume_from_camera.s159) * beside.y) / brick_m;
    while (near < MAXFLOAT) {  // a tile on an edge contains several surfaces
        const float edge = fmax(near + 0.5f * brick_m, 1.001f * near);  // more than near, with any voxel size
        float4 far = (float4)(near), next = (float4)(MAXFLOAT);
        for (int row = 0; row < TILE; row++) {
            const float4 four = vload4(row, depth);
            far = select(far, fmax(far, four), four < edge);
            next = select(next, fmin(next, four), four >= edge);
        }
        piece.near = near - reach_z;
        piece.far = fmax(fmax(far.x, far.y), fmax(far.z, far.w)) + reach_z;
        mark_frustum(bricks, piece, marked);
        near = fmin(fmin(next.x, next.y), fmin(next.z, next.w));
    }
}

// Element i: bit 2 k + i % 2 where voxel i of a row of 8 is solid (seen, tsdf < 0); k: the row's number in its cells.
static inline int8 solid_bits(global const float2 *row, const int k) {
    const float16 voxels = vload16(0, (global const float *)row);
    const int8 bits = (int8)(1, 2, 1, 2, 1, 2, 1, 2) << (int8)(2 * k);
    return (voxels.odd > 0.0f && voxels.even < 0.0f) & bits;
}

// listed [count] brick indices -> solid [z][y][x]: bit (z 4 + y) 4 + x where a cell of 2x2x2 voxels contains a solid voxel;
// octets [slot][64]: the solid voxels of each cell. 16 items a brick, 4 bricks a work-group; an item is a row of 4 cells.
kernel void find_solid(const int count, global const int *listed, global const int *slots, global const float2 *voxels,
                       global ulong *solid, global uchar *octets) {
    local uint cells[64];
    const int item = get_local_id(0);
    const int place = get_global_id(0) >> 4;
    const int row = item & 15;
    const int index = listed[min(place, count - 1)];
    const int first = (row >> 2) * 2 * BRICK * BRICK + (row & 3) * 2 * BRICK;
    global const float2 *corner = voxels + slots[index] * BRICK_VOXELS + first;
    const int8 bits = solid_bits(corner, 0) | solid_bits(corner + BRICK, 1) | solid_bits(corner + BRICK * BRICK, 2) |
                      solid_bits(corner + BRICK * BRICK + BRICK, 3);
    const int4 found = bits.even | bits.odd;
    const int4 set = (found != 0) & (int4)(1, 2, 4, 8);
    cells[item] = set.x | set.y | set.z | set.w;
    if (place < count) vstore4(convert_uchar4(found), slots[index] * 16 + row, octets);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (row == 0 && place < count) {
        ulong mask = 0;
        for (int i = 0; i < 16; i++) mask |= (ulong)cells[item + i] << (4 * i);
        solid[index] = mask;
    }
}

// Cells of the brick at `offset` (-1, 0, 1) along an axis that lie within two cells of this brick; `low` and `high` are the
// halves of a brick along the axis.
static inline ulong facing_half(const int offset, const ulong low, const ulong high) {
    return offset > 0 ? low : offset < 0 ? high : (low | high);
}

// listed [count] brick indices -> near [count]: 1 where the brick, or a neighbour within two cells (4 voxels), contains a
// solid voxel. Other bricks are never interpolated by a ray that searches for a surface.
kernel void find_near_solid(const int count, global const int *listed, const int4 bricks, global const ulong *solid,
                            global uchar *near) {
    const int item = get_global_id(0);
    if (item >= count) return;
    const int index = listed[item];
    const int3 here = (int3)(index % bricks.x, (index / bricks.x) % bricks.y, index / (bricks.x * bricks.y));
    ulong any = 0;
    for (int i = 0; i < 27; i++) {
        const int3 offset = (int3)(i % 3, (i / 3) % 3, i / 9) - 1;
        if (!inside_bricks(bricks, here + offset)) continue;
        any |= solid[brick_index(bricks, here + offset)] & facing_half(offset.x, 0x3333333333333333UL, 0xCCCCCCCCCCCCCCCCUL) &
               facing_half(offset.y, 0x00FF00FF00FF00FFUL, 0xFF00FF00FF00FF00UL) &
               facing_half(offset.z, 0x00000000FFFFFFFFUL, 0xFFFFFFFF00000000UL);
    }
    near[item] = any != 0;
}

// Corners of the box around the bricks that have become solid or empty, in bricks. The low one is negated, so that one value fills all six.
#define CHANGED_LOW 0
#define CHANGED_HIGH 3

// Row (y, z) of solid [z][y][x] and occupied [z][y][x] (1: the brick had a solid voxel at the last update) -> occupied, and
// gap [2][z][y][x]: bricks to the nearest occupied one of the row, at most `limit`, towards lower x and towards higher. -> the first and
// the last x that changed; where none did, (bricks.x, -1), and the gaps stay.
static int2 row_gaps(const int4 bricks, const int y, const int z, const int limit, global const ulong *solid, global uchar *occupied,
                     global uchar *gap) {
    const int first = (z * bricks.y + y) * bricks.x;
    int low = bricks.x, high = -1, back = limit, ahead = limit;
    for (int x = 0; x < bricks.x; x++) {
        const uchar now = solid[first + x] != 0;
        if (now != occupied[first + x]) {
            low = min(low, x);
            high = x;
            occupied[first + x] = now;
        }
    }
    if (high < 0) return (int2)(low, high);
    for (int x = 0; x < bricks.x; x++) {
        back = occupied[first + x] ? 0 : min(back + 1, limit);
        gap[first + x] = (uchar)back;
    }
    global uchar *onward = gap + bricks.x * bricks.y * bricks.z;
    for (int x = bricks.x - 1; x >= 0; x--) {
        ahead = occupied[first + x] ? 0 : min(ahead + 1, limit);
        onward[first + x] = (uchar)ahead;
    }
    return (int2)(low, high);
}

// Adds one axis (1 = y, 2 = z) to the one-sided Chebyshev distance of 16 bricks from (x, y, z) on: the minimum, over bricks `offset`
// ahead, of max(offset, their distance so far). inner [variants][z][y][x] and 16 bytes more -> gap [2 variants][z][y][x]: towards lower
// indices, then towards higher ones.
static void add_axis(const int4 bricks, const int x, const int y, const int z, const int variant, const int variants, const int axis,
                     const int limit, global const uchar *inner, global uchar *gap) {
    const int volume = bricks.x * bricks.y * bricks.z;
    const int position = axis == 1 ? y : z;
    const int size = axis == 1 ? bricks.y : bricks.z;
    const int is_ahead = variant >= variants;
    const int stride = (is_ahead ? 1 : -1) * (axis == 1 ? bricks.x : bricks.x * bricks.y);
    const int room = min(is_ahead ? size - 1 - position : position, limit - 1);
    const int place = (z * bricks.y + y) * bricks.x + x;
    global const uchar *from = inner + (variant % variants) * volume + place;
    uchar16 nearest = (uchar16)(limit);
    for (int offset = 0; offset <= room; offset++)
        nearest = min(nearest, max(vload16(0, from + offset * stride), (uchar16)(offset)));
    global uchar *to = gap + variant * volume + place;
    if (bricks.x >= 16) {
        vstore16(nearest, 0, to);
        return;
    }
    uchar values[16];
    vstore16(nearest, 0, values);
    for (int i = 0; i < bricks.x; i++) to[i] = values[i];
}

// First of the 16 bricks of a row that are worked on together.
static inline int first_of_16(const int4 bricks, const int part) {
    return max(min(16 * part, bricks.x - 16), 0);
}

#define SLICE_VARIANTS 4  // ways along x and y

// solid, occupied [z][y][x] as of row_gaps -> occupied, changed [6], and gaps along x and then y: along_x [2][z][y][x],
// along_y [4][z][y][x]. A group of any size is a slice of one z, which is all that these two axes need.
kernel void gaps_in_slices(const int4 bricks, global const ulong *solid, const int limit, global uchar *occupied,
                           global int *changed, global uchar *along_x, global uchar *along_y) {
    local int box[4];  // of what changed in the slice: low x, low y, high x, high y
    const int item = get_local_id(0), items = get_local_size(0), z = group_number();
    if (item == 0) box[0] = bricks.x, box[1] = bricks.y, box[2] = -1, box[3] = -1;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int y = item; y < bricks.y && z < bricks.z; y += items) {
        const int2 ends = row_gaps(bricks, y, z, limit, solid, occupied, along_x);
        if (ends.y < 0) continue;
        atomic_min(box, ends.x);
        atomic_min(box + 1, y);
        atomic_max(box + 2, ends.y);
        atomic_max(box + 3, y);
    }
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (z >= bricks.z || box[2] < 0) return;
    if (item == 0) {
        atomic_max(changed + CHANGED_LOW, -box[0]);
        atomic_max(changed + CHANGED_LOW + 1, -box[1]);
        atomic_max(changed + CHANGED_LOW + 2, -z);
        atomic_max(changed + CHANGED_HIGH, box[2]);
        atomic_max(changed + CHANGED_HIGH + 1, box[3]);
        atomic_max(changed + CHANGED_HIGH + 2, z);
    }
    const int parts = (bricks.x + 15) / 16, low = max(box[1] - limit, 0), rows = min(box[3] + limit, bricks.y - 1) - low + 1;
    for (int piece = item; piece < parts * rows * SLICE_VARIANTS; piece += items) {
        const int x = first_of_16(bricks, piece % parts), y = low + (piece / parts) % rows, variant = piece / (parts * rows);
        if (x + 15 < box[0] - limit || x > box[2] + limit) continue;
        add_axis(bricks, x, y, z, variant, SLICE_VARIANTS / 2, 1, limit, along_x, along_y);
    }
}

// The third axis: along_y [4][z][y][x] and 16 bytes more -> gap [8][z][y][x], only near the `changed` box. One item 16 bricks of a row.
kernel void gaps_along_z(const int4 bricks, global const uchar *along_y, const int limit, global const int *changed, global uchar *gap) {
    const int x = first_of_16(bricks, get_global_id(0));
    const int y = get_global_id(1);
    const int z = get_global_id(2) % bricks.z;
    const int variant = get_global_id(2) / bricks.z;
    if (16 * get_global_id(0) >= bricks.x || y >= bricks.y || variant >= 2 * SLICE_VARIANTS) return;
    if (x + 15 < -changed[CHANGED_LOW] - limit || x > changed[CHANGED_HIGH] + limit) return;
    if (y < -changed[CHANGED_LOW + 1] - limit || y > changed[CHANGED_HIGH + 1] + limit) return;
    if (z < -changed[CHANGED_LOW + 2] - limit || z > changed[CHANGED_HIGH + 2] + limit) return;
    add_axis(bricks, x, y, z, variant, SLICE_VARIANTS, 2, limit, along_y, gap);
}
