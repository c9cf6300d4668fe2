// Depth views of the volume from all around it, and visibility look-ups in them (thesis 6.2.1, 7.3.2).
// Provides draw_views, look_into_views.
#include "direction_sets.clh"
#include "rays.clh"
#include "samples.clh"

#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif
#ifndef SIDE
#error SIDE must be defined: pixels of an auxiliary view's side
#endif

// Slope of the outermost pixel centres' lines of sight is SIDE / 2 - 1 / 2 of these.
static inline float slope_of(const float pixel, const float per_pixel) {
    return (pixel - 0.5f * (SIDE - 1)) * per_pixel;
}

// Where the lines of sight of auxiliary views first meet a solid voxel: surface behind it gets no light from the view's direction.
// One item LANES pixels of a row of views[get_global_id(2)]. axes [views][3]: right, down and forward, unit, volume space; a
// view's eye is distance_m before center. per_pixel: slope of a pixel. -> depths [view][SIDE][SIDE]: metres along the axis, 0 = none.
kernel void draw_views(const int count, global const int *views, VOLUME_PARAMETERS, const float4 center, const float distance_m,
                       const float per_pixel,
                       global const float4 *axes, global float *depths) {
    const int x = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    if (x >= SIDE || y >= SIDE || (int)get_global_id(2) >= count) return;
    const int view = views[get_global_id(2)];
    const float4 right = axes[3 * view], down = axes[3 * view + 1], ahead = axes[3 * view + 2];
    const Volume volume = VOLUME_OF_PARAMETERS;
    const floatn across = (CONVERT_FLOATN(x + CONVERT_INTN(LANE_NUMBERS)) - 0.5f * (SIDE - 1)) * per_pixel;
    const float4 middle = ahead + slope_of(y, per_pixel) * down;
    const floatn shorten = 1.0f / sqrt(across * across + dot(middle, middle));
    const Vectors direction = {(middle.x + across * right.x) * shorten, (middle.y + across * right.y) * shorten,
                               (middle.z + across * right.z) * shorten};
    const Rays rays = make_rays((center.xyz - distance_m * ahead.xyz) / shape.voxel_m, direction);
    floatn begin, end;
    clip_rays(volume, rays, &begin, &end);
    const floatn t = find_solid_voxels(volume, rays, begin, end);
    float found[LANES];
    STORE_LANES((MASK(t < end) & MASK(begin < end)) ? t * shorten * shape.voxel_m : 0.0f, found);
    for (int lane = 0; lane < min(LANES, SIDE - x); lane++) depths[(view * SIDE + y) * SIDE + x + lane] = found[lane];
}

// Samples of the same direction set: every 8th sample along both axes has the same set (direction_sets.clh), so all of them look into
// the same view for one direction. An item looks for a block of those, LANES at a time.
#define SET_STEP 8
#define BLOCK_SIDE (LANES == 8 ? 16 : 1)

#define BLOCK_CELLS 0x330033ul  // the cells of the first block of 4x4x4 voxels in a brick

// Whether surface is still there that a view met at `at` (voxel units) when it was drawn: a block of 4x4x4 voxels with a solid one,
// half a voxel or two and a half behind it. Noise moves surface within a block; what has been taken away leaves none.
static bool is_still_there(const Volume volume, const float3 at, const float3 ahead) {
    for (float behind = 0.5f; behind < 3.0f; behind += 2.0f) {
        const int3 v = clamp(convert_int3(at + behind * ahead), (int3)(0), volume.bricks.xyz * BRICK - 1);
        const int3 brick = v / BRICK, cell = (v & (BRICK / 2)) / 2;
        const ulong cells = volume.solid[(brick.z * volume.bricks.y + brick.y) * volume.bricks.x + brick.x];
        if ((cells >> ((cell.z * 4 + cell.y) * 4 + cell.x)) & BLOCK_CELLS) return true;
    }
    return false;
}

// Those of the lanes in `hidden` whose surface at h (from the views' centre) has gone since their view was drawn.
static int no_longer_hidden(const Volume volume, const int hidden, const Vectors h, const float4 center, const float4 ahead) {
    float x[LANES], y[LANES], z[LANES];
    STORE_LANES(h.x, x);
    STORE_LANES(h.y, y);
    STORE_LANES(h.z, z);
    int gone = 0;
    for (int lane = 0; lane < LANES; lane++) {
        if (!((hidden >> lane) & 1)) continue;
        const float3 at = ((float3)(x[lane], y[lane], z[lane]) + center.xyz) / volume.voxel_m;
        if (!is_still_there(volume, at, ahead.xyz)) gone |= 1 << lane;
    }
    return gone;
}

// The bits of LANES samples at o (from the views' centre) with normals n: bit j of `bits` [LANES][MASK_WORDS], 0 before, is set where
// direction j of the set that begins at `set` lies above the surface and its light arrives. shift: of a sample within its pixel.
static void look(const LookUpParameters p, const Volume volume, const Vectors o, const Vectors n, const int set, const float shift_x,
                 const float shift_y, global const float4 *directions, global const int *view_of, global const float4 *axes,
                 global const float *depths, uint *bits) {
    const float distance_m = p.distance_m, per_pixel = p.per_pixel;
    for (int j = 0; j < p.count; j++) {
        const float4 w = directions[set + j];
        const intn above = MASK(n.x * w.x + n.y * w.y + n.z * w.z > 0.0f);
        if (!ANY(above)) continue;
        const int view = view_of[set + j];
        const float4 right = axes[3 * view], down = axes[3 * view + 1], ahead = axes[3 * view + 2];
        const floatn z = ahead.x * o.x + ahead.y * o.y + ahead.z * o.z + distance_m;
        const floatn pixels = 1.0f / (z * per_pixel);
        const floatn x = (right.x * o.x + right.y * o.y + right.z * o.z) * pixels + shift_x;
        const floatn y = (down.x * o.x + down.y * o.y + down.z * o.z) * pixels + shift_y;
        const intn col = clamp(CONVERT_INTN(x), 0, SIDE - 1), row = clamp(CONVERT_INTN(y), 0, SIDE - 1);
        const floatn depth = GATHER_FLOATN(depths, ((view * SIDE + row) * SIDE + col) & above);
        const floatn sx = (CONVERT_FLOATN(col) - 0.5f * (SIDE - 1)) * per_pixel, sy = (CONVERT_FLOATN(row) - 0.5f * (SIDE - 1)) * per_pixel;
        const floatn tx = depth * (sx * right.x + sy * down.x + ahead.x) - (distance_m * ahead.x + o.x);
        const floatn ty = depth * (sx * right.y + sy * down.y + ahead.y) - (distance_m * ahead.y + o.y);
        const floatn tz = depth * (sx * right.z + sy * down.z + ahead.z) - (distance_m * ahead.z + o.z);
        const intn hidden = MASK(depth > 0.0f) & MASK(depth < z) & MASK(tx * n.x + ty * n.y + tz * n.z > p.lift_m) &
                            MASK(tx * tx + ty * ty + tz * tz < p.ray_length_m * p.ray_length_m);
        const Vectors met = {tx + o.x, ty + o.y, tz + o.z};
        const int arrives = bits_of(above & ~hidden) | no_longer_hidden(volume, bits_of(above & hidden), met, p.center, ahead);
        for (int lane = 0; lane < LANES; lane++)
            bits[lane * MASK_WORDS + (j >> 5)] |= (uint)((arrives >> lane) & 1) << (j & 31);
    }
}

// Whether the auxiliary view along each direction sees the sample: no surface in the sample's pixel of the view is nearer to the
// view, within ray_length_m of the sample, above its tangent plane by lift_m and still there.
//
// One item a block of BLOCK_SIDE x BLOCK_SIDE samples of one set; there are block_cols x block_rows blocks of each set. positions
// [h][w], sample_normals [rows][cols]: nothing is looked up and `lit` is not written where w = 0; axes, depths: see draw_views;
// view_of [sets][count]: the view for a direction.
// -> lit [rows][cols][MASK_WORDS]: bit j = direction j lies above the surface and its light arrives.
kernel void look_into_views(const LookUpParameters p, VOLUME_PARAMETERS, global const float4 *positions,
                            global const float4 *sample_normals, global const float4 *directions, global const int *view_of,
                            global const float4 *axes, global const float *depths, global uint *lit) {
    const Volume volume = VOLUME_OF_PARAMETERS;
    const int item = get_global_id(0);
    const int cols = p.grid.cols, rows = p.grid.rows, blocks = p.block_cols * p.block_rows;
    if (item >= SET_STEP * SET_STEP * blocks) return;
    const int place = item / blocks, block = item % blocks;
    const int first_col = place % SET_STEP + block % p.block_cols * (SET_STEP * BLOCK_SIDE);
    const int first_row = place / SET_STEP + block / p.block_cols * (SET_STEP * BLOCK_SIDE);
    const float shift_x = 0.5f * SIDE + (first_col & 1) * 0.5f - 0.25f, shift_y = 0.5f * SIDE + (first_row & 1) * 0.5f - 0.25f;
    const int set = (p.first_set + direction_set(first_row, first_col)) * p.count;
    float px[LANES], py[LANES], pz[LANES], nx[LANES], ny[LANES], nz[LANES];
    int sample[LANES];
    int waiting = 0;
    for (int i = 0; i < BLOCK_SIDE * BLOCK_SIDE; i++) {
        const int col = first_col + i % BLOCK_SIDE * SET_STEP, row = first_row + i / BLOCK_SIDE * SET_STEP;
        if (col < cols && row < rows && sample_normals[row * cols + col].w > 0.0f) {
            const float4 position = positions[sample_pixel(p.grid, row, col)] - p.center, normal = sample_normals[row * cols + col];
            px[waiting] = position.x, py[waiting] = position.y, pz[waiting] = position.z;
            nx[waiting] = normal.x, ny[waiting] = normal.y, nz[waiting] = normal.z;
            sample[waiting++] = row * cols + col;
        }
        if (waiting == 0 || (waiting < LANES && i < BLOCK_SIDE * BLOCK_SIDE - 1)) continue;
        for (int lane = waiting; lane < LANES; lane++)
            px[lane] = px[0], py[lane] = py[0], pz[lane] = pz[0], nx[lane] = nx[0], ny[lane] = ny[0], nz[lane] = nz[0];
        const Vectors o = {LOAD_LANES(px), LOAD_LANES(py), LOAD_LANES(pz)}, n = {LOAD_LANES(nx), LOAD_LANES(ny), LOAD_LANES(nz)};
        uint bits[LANES * MASK_WORDS];
        for (int k = 0; k < LANES * MASK_WORDS; k++) bits[k] = 0;
        look(p, volume, o, n, set, shift_x, shift_y, directions, view_of, axes, depths, bits);
        for (int lane = 0; lane < waiting; lane++)
            for (int k = 0; k < MASK_WORDS; k++) lit[sample[lane] * MASK_WORDS + k] = bits[lane * MASK_WORDS + k];
        waiting = 0;
    }
}
