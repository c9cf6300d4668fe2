// Draws triangle meshes into the virtual geometry buffer (the rasterised buffer of section 7.2, fig. 7.5).
//
// setup_triangles -> scan_tiles -> fill_tiles -> raster_tiles -> clear_uncovered -> shade_surface, once per object the
// first and the last. Screen positions are snapped to 1/256 pixel and edges evaluated in exact integers, so that
// triangles sharing an edge cover each pixel centre once (top-left rule). Pixel centres lie at integers.
//
// A piece is a triangle after clipping. `corners` [pieces] int8: x0 y0 x1 y1 x2 y2 in subpixels, turned to positive
// area; the triangle's number among all objects, -1 for no piece; the object's index.
// `inverse_depths` [pieces] float4: 1 / z at the corners, 1/metre.
#pragma OPENCL FP_CONTRACT OFF  // the same vertex must land on the same subpixel in every triangle that shares it
#include "camera.clh"
#include "clip.clh"
#include "edges.clh"

#define SCAN_ITEMS 256

static inline int2 snapped(const float3 point) {
    return convert_int2_rte(point.xy / point.z * (float)SUBPIXELS);
}

// The piece with corners a, b, c, turned to positive area; its triangle is -1 if it covers no pixel centre.
static int8 make_piece(const float3 a, const float3 b, const float3 c, const int2 ids, const int2 size,
                       float4 *inverse_depths) {
    const int2 p = snapped(a), q = snapped(b), r = snapped(c);
    const long area = (long)(q.x - p.x) * (r.y - p.y) - (long)(q.y - p.y) * (r.x - p.x);
    const bool turn = area < 0;
    const int8 piece = (int8)(p, turn ? r : q, turn ? q : r, ids);
    *inverse_depths = 1.0f / (float4)(a.z, turn ? c.z : b.z, turn ? b.z : c.z, 1.0f);
    const int4 bounds = pixel_bounds(piece, size);
    return area == 0 || bounds.x > bounds.z || bounds.y > bounds.w ? (int8)(-1) : piece;
}

static void count_tiles(const int8 piece, const int2 size, global int *tile_counts) {
    if (piece.s6 < 0) return;
    const int4 tiles = pixel_bounds(piece, size) / TILE;
    for (int y = tiles.y; y <= tiles.w; y++)
        for (int x = tiles.x; x <= tiles.z; x++)
            if (touches_tile(piece, tiles, (int2)(x, y))) atomic_inc(&tile_counts[y * tile_columns(size) + x]);
}

// Ready for a new picture: no extra pieces (counts[0]), no piece in any tile (the rest).
kernel void clear_counts(const int count, global int *counts) {
    const int index = get_global_id(0);
    if (index < count) counts[index] = 0;
}

// One triangle of one object: to pixels, clipped, its pieces written and counted in the tiles they touch. Its first
// piece has the place of its number; others are appended after those of all triangles. counts[0] counts the appended,
// also those for which there is no room; counts[1 + tile] the pieces of each tile.
// sizes: triangles, number of the first one, triangles of all objects, room after them. picture: width, height, object.
kernel void setup_triangles(const int4 sizes, const int4 picture, const global float *vertices,
                            const global int *triangles, const float16 pixel_from_model, const float near_m,
                            global int *counts, global int8 *corners, global float4 *inverse_depths) {
    const int triangle = get_global_id(0);
    if (triangle >= sizes.x) return;
    const int3 vertex = vload3(triangle, triangles);
    float3 corner[MAX_CORNERS];
    corner[0] = transform_point(pixel_from_model, vload3(vertex.x, vertices));
    corner[1] = transform_point(pixel_from_model, vload3(vertex.y, vertices));
    corner[2] = transform_point(pixel_from_model, vload3(vertex.z, vertices));
    const int count = clip_triangle(near_m, corner);
    const int2 ids = (int2)(sizes.y + triangle, picture.z);
    int written = 0;
    for (int i = 2; i < count; i++) {
        float4 depths;
        const int8 piece = make_piece(corner[0], corner[i - 1], corner[i], ids, picture.xy, &depths);
        if (piece.s6 < 0) continue;
        const int slot = written++ ? sizes.z + atomic_inc(counts) : ids.x;
        if (slot >= sizes.z + sizes.w) continue;
        corners[slot] = piece;
        inverse_depths[slot] = depths;
        count_tiles(piece, picture.xy, counts + 1);
    }
    if (!written) corners[ids.x] = (int8)(-1);
}

// Exclusive running sum over the tiles' counts, by one work-group. starts[tiles] is the sum of all, and the last
// number counts[0], for the host to read both at once.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1)))
void scan_tiles(const int tiles, const global int *counts, global int *starts) {
    const global int *tile_counts = counts + 1;
    local int sums[SCAN_ITEMS];
    const int item = get_local_id(0);
    const int share = (tiles + SCAN_ITEMS - 1) / SCAN_ITEMS;
    const int begin = min(item * share, tiles), end = min(begin + share, tiles);
    int sum = 0;
    for (int tile = begin; tile < end; tile++) sum += tile_counts[tile];
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    int before = 0;
    for (int i = 0; i < item; i++) before += sums[i];
    for (int tile = begin; tile < end; tile++) {
        starts[tile] = before;
        before += tile_counts[tile];
    }
    if (item == SCAN_ITEMS - 1) {
        starts[tiles] = before;
        starts[tiles + 1] = counts[0];
    }
}

// Lists each piece in the tiles it touches. Counts the tiles down to 0; the order within a tile does not matter.
kernel void fill_tiles(const int pieces, const int width, const int height, const global int8 *corners,
                       const global int *starts, global int *counts, global int *entries) {
    const int2 size = (int2)(width, height);
    const int index = get_global_id(0);
    if (index >= pieces) return;
    const int8 piece = corners[index];
    if (piece.s6 < 0) return;
    const int4 tiles = pixel_bounds(piece, size) / TILE;
    for (int y = tiles.y; y <= tiles.w; y++)
        for (int x = tiles.x; x <= tiles.z; x++) {
            if (!touches_tile(piece, tiles, (int2)(x, y))) continue;
            const int tile = y * tile_columns(size) + x;
            entries[starts[tile] + atomic_dec(&counts[1 + tile]) - 1] = index;
        }
}

// The nearer of the best so far and a piece that covers the pixel, as (triangle, object); the lower triangle number
// where they are equally far. Depth is interpolated as 1 / z, which is linear on the screen.
static int2 nearer(const int8 piece, const float4 inverse_depths, const int2 pixel, const int2 best, float *nearest) {
    const float3 share = convert_float3(edges_at(piece, pixel));
    const float inverse_depth = dot(share, inverse_depths.xyz) / (share.x + share.y + share.z);
    if (inverse_depth < *nearest || (inverse_depth == *nearest && piece.s6 > best.x)) return best;
    *nearest = inverse_depth;
    return piece.s67;
}

// One work-group a tile, one work-item a pixel: 64 entries at a time, first their coverage, one entry an item, then
// each pixel looks through those that cover it.
kernel __attribute__((reqd_work_group_size(TILE * TILE, 1, 1)))
void raster_tiles(const int width, const int height, const global int8 *corners, const global float4 *inverse_depths,
                  const global int *starts, const global int *entries, global int *visible, global int *objects) {
    const int2 size = (int2)(width, height);
    local ulong masks[TILE * TILE];
    const int tile = get_group_id(0), item = get_local_id(0);
    const int2 origin = TILE * (int2)(tile % tile_columns(size), tile / tile_columns(size));
    const int2 pixel = origin + (int2)(item % TILE, item / TILE);
    int2 best = (int2)(-1);
    float nearest = 0.0f;
    for (int begin = starts[tile]; begin < starts[tile + 1]; begin += TILE * TILE) {
        const int count = min(starts[tile + 1] - begin, TILE * TILE);
        masks[item] = item < count ? coverage(corners[entries[begin + item]], origin, size) : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = 0; i < count; i++) {
            const int piece = entries[begin + i];
            if ((masks[i] >> item) & 1) best = nearer(corners[piece], inverse_depths[piece], pixel, best, &nearest);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (pixel.x < size.x && pixel.y < size.y) {
        visible[pixel.y * size.x + pixel.x] = best.x;
        objects[pixel.y * size.x + pixel.x] = best.y;
    }
}

// Says where there is no virtual surface: w = 0.
kernel void clear_uncovered(const int pixels, const global int *visible, global float4 *position, global float4 *normal,
                            global float4 *base_color) {
    const int pixel = get_global_id(0);
    if (pixel >= pixels || visible[pixel] >= 0) return;
    position[pixel] = normal[pixel] = base_color[pixel] = (float4)(0.0f);
}

// Where the ray origin + t * direction meets the plane of a, a + ab, a + ac (Moeller and Trumbore): the shares of the
// second and third corner, and t. A plane seen edge on is met nowhere: its middle is taken, and t = 0.
static float3 intersect_plane(const float3 a, const float3 ab, const float3 ac, const float3 origin,
                              const float3 direction) {
    const float3 p = cross(direction, ac), q = cross(origin - a, ab);
    const float determinant = dot(ab, p);
    if (determinant == 0.0f) return (float3)(1.0f / 3.0f, 1.0f / 3.0f, 0.0f);
    return (float3)(dot(origin - a, p), dot(direction, q), dot(ac, q)) / determinant;
}

// The shares of all three corners, none below 0: a pixel that is covered may lie outside by half a subpixel.
static inline float3 shares_inside(const float3 hit) {
    const float2 share = clamp(hit.xy, 0.0f, 1.0f);
    const float sum = fmax(share.x + share.y, 1.0f);
    return (float3)(1.0f - (share.x + share.y) / sum, share / sum);
}

// The point at which the ray is as deep as it meets the plane, but no nearer or farther than the triangle is.
static inline float3 point_on_ray(const float16 model_from_pixel, const float3 a, const float3 ab, const float3 ac,
                                  const float3 direction, const float t) {
    const float3 slope = model_from_pixel.scde;
    const float depth = dot(slope, a) + model_from_pixel.sf, to_b = dot(slope, ab), to_c = dot(slope, ac);
    const float nearest = depth + fmin(fmin(to_b, to_c), 0.0f), farthest = depth + fmax(fmax(to_b, to_c), 0.0f);
    return model_from_pixel.s37b + fmin(fmax(t, fmax(nearest, 0.0f)), farthest) * direction;
}

static float3 unit_or(const float3 vector, const float3 otherwise) {
    const float length_squared = dot(vector, vector);
    return length_squared > 1e-30f ? vector / sqrt(length_squared) : otherwise;
}

// `normal` on the side of the triangle's own `facing` that is seen, bent where it would still turn its back on the
// camera: so it never flips from one pixel to the next along a smooth outline. All of any length but `to_camera`.
static float3 facing_camera(const float3 normal, const float3 facing, const float3 to_camera) {
    const float3 flat = unit_or(dot(facing, to_camera) < 0.0f ? -facing : facing, to_camera);
    const float3 smooth = unit_or(normal, flat);
    const float3 turned = dot(smooth, flat) < 0.0f ? -smooth : smooth;
    return unit_or(turned - fmin(dot(turned, to_camera), 0.0f) * to_camera, flat);
}

// The surface that one object shows: position in volume metres, unit normal, linear base colour; w = 1.
// sizes: width, height, number of the object's first triangle, its triangles. `attributes` [v, 6]: normal, base colour.
// The ray of pixel (u, v) is model_from_pixel's column 3 + t * its columns 0 to 2 times (u, v, 1), with t the depth;
// its last row is not part of that: it takes a model point to its depth.
kernel void shade_surface(const int4 sizes, const global int *visible, const global float *vertices,
                          const global int *triangles, const global float *attributes, const float16 model_from_pixel,
                          const float16 volume_from_model, global float4 *position, global float4 *normal,
                          global float4 *base_color) {
    const int2 pixel = (int2)(get_global_id(0), get_global_id(1));
    if (pixel.x >= sizes.x || pixel.y >= sizes.y) return;
    const int index = pixel.y * sizes.x + pixel.x, triangle = visible[index] - sizes.z;
    if (triangle < 0 || triangle >= sizes.w) return;
    const int3 v = vload3(triangle, triangles);
    const float3 a = vload3(v.x, vertices), ab = vload3(v.y, vertices) - a, ac = vload3(v.z, vertices) - a;
    const float3 direction = transform_vector(model_from_pixel, (float3)(pixel.x, pixel.y, 1.0f));
    const float3 hit = intersect_plane(a, ab, ac, model_from_pixel.s37b, direction);
    const float3 share = shares_inside(hit), point = point_on_ray(model_from_pixel, a, ab, ac, direction, hit.z);
    const float3 mean_normal = share.x * vload3(2 * v.x, attributes) + share.y * vload3(2 * v.y, attributes)
                               + share.z * vload3(2 * v.z, attributes);
    const float3 mean_color = share.x * vload3(2 * v.x + 1, attributes) + share.y * vload3(2 * v.y + 1, attributes)
                              + share.z * vload3(2 * v.z + 1, attributes);
    const float3 seen_normal = facing_camera(mean_normal, cross(ab, ac), -normalize(direction));
    position[index] = (float4)(transform_point(volume_from_model, point), 1.0f);
    normal[index] = (float4)(normalize(transform_vector(volume_from_model, seen_normal)), 1.0f);
    base_color[index] = (float4)(mean_color, 1.0f);
}
