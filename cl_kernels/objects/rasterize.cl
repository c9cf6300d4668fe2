// Draws triangle meshes into the virtual geometry buffer (the rasterised buffer of section 7.2, fig. 7.5).
//
// begin_picture -> setup_triangles -> scan_tiles -> fill_tiles -> raster_tiles -> settle_fragments -> shade_surface, each
// once for all objects. Screen positions are snapped to 1/256 pixel and edges evaluated in exact
// integers, so that triangles sharing an edge cover each pixel centre once (top-left rule). Pixel centres lie at
// integers. Triangles that cover only a few pixels are drawn directly, as fragments, all others through lists per tile.
// First the nearest depth of each pixel is found, then the lowest triangle index with that depth: the result does not
// depend on the order of processing.
//
// The meshes of all objects lie one after the other (server/objects/arena.py). `objects` [n] int8, one row an object of
// the picture: its mesh's first vertex, first triangle and first material; its numbers of vertices and triangles; the
// indices of its first triangle and of its first vertex in this picture. Rows out of view have no triangles.
// `matrices` [3 n] float16, three an object: pixel_from_model, model_from_pixel (see shade_surface), volume_from_model.
// `chunks` int2, one a work-group: an object, and the first of its CHUNK vertices or triangles that the group processes.
//
// `projected` [vertices] int4: x and y in subpixels, 1 / depth as bits (0: outside, to be clipped), 1 if behind.
// A piece is a triangle after clipping. `corners` [pieces] int8: x0 y0 x1 y1 x2 y2 in subpixels, turned to positive
// area; the triangle's number in this picture. `inverse_depths` [pieces] float4: 1 / depth at the corners, 1/metre.
// A fragment is one pixel of a small piece: the pixel, the bits of 1 / depth, the triangle's index, 0.
// `nearest` [h][w] bits of the greatest 1 / depth so far, which order as the numbers do; 0 where there is none.
// `counts` [2 + tiles] pieces, fragments, and the pieces of each tile.
#pragma OPENCL FP_CONTRACT OFF  // the same vertex must land on the same subpixel in every triangle that shares it
#include "camera.clh"
#include "groups.clh"
#include "pieces.clh"
#include "surface_point.clh"
#include "textures.clh"

#define CHUNK 128  // vertices or triangles of one object per work-group
#define SCAN_ITEMS 256
#define FEW 16         // pieces that a tile's pixels test themselves
#define COLOR_PROBES 4  // most samples of a base colour along a pixel's footprint; more look the same
#define NOBODY 0x7fffffff

static void count_tiles(const int8 piece, const int2 size, global int *tile_counts) {
    const int4 tiles = pixel_bounds(piece, size) / TILE;
    for (int y = tiles.y; y <= tiles.w; y++)
        for (int x = tiles.x; x <= tiles.z; x++)
            if (touches_tile(piece, tiles, (int2)(x, y))) atomic_inc(&tile_counts[y * tile_columns(size) + x]);
}

static void write_piece(const int8 piece, const float4 depths, const int slot, const int room, const int2 size,
                        global int *tile_counts, global int8 *corners, global float4 *inverse_depths) {
    if (slot >= room) return;
    corners[slot] = piece;
    inverse_depths[slot] = depths;
    count_tiles(piece, size, tile_counts);
}

// Clears the counters and the depths of the tiles of `region` (x0 y0 x1 y1, half-open).
// One item a row of pixels of a tile.
static void clear_picture(const int index, const int2 size, const int4 region, const int count, global int *counts,
                          global uint *nearest) {
    if (index < count) counts[index] = 0;
    const int columns = region.z - region.x;
    if (columns <= 0 || index >= columns * (region.w - region.y) * TILE) return;
    const int x = TILE * (region.x + index % columns), y = TILE * region.y + index / columns;
    if (y >= size.y) return;
    if (x + TILE <= size.x) vstore8((uint8)(0), 0, nearest + y * size.x + x);
    else for (int i = x; i < size.x; i++) nearest[y * size.x + i] = 0;
}

// Clears the picture, and finds every vertex of the objects in view on the screen. The work-groups are at least those
// of the `chunk_count` chunks.
kernel __attribute__((reqd_work_group_size(CHUNK, 1, 1)))
void begin_picture(const int2 size, const int4 region, const int count, const int chunk_count, const global int2 *chunks,
                   const global int8 *objects, const global float16 *matrices, const float near_m,
                   const global float *vertices, global int *counts, global uint *nearest, global int4 *projected) {
    clear_picture(get_global_id(0), size, region, count, counts, nearest);
    if (group_number() >= chunk_count) return;
    const int2 chunk = chunks[group_number()];
    const int8 object = objects[chunk.x];
    const int vertex = chunk.y + get_local_id(0);
    if (vertex >= object.s3) return;
    const float3 point = transform_point(matrices[3 * chunk.x], vload3(object.s0 + vertex, vertices));
    projected[object.s6 + vertex] = on_screen(point, near_m);
}

// Clips a triangle that crosses the near plane or the guard band, and writes its pieces.
static void write_clipped(const float16 pixel_from_model, const global float *vertices, const int3 vertex,
                          const float near_m, const int triangle, const int room, const int2 size, global int *counts,
                          global int8 *corners, global float4 *inverse_depths) {
    float3 corner[MAX_CORNERS];
    corner[0] = transform_point(pixel_from_model, vload3(vertex.x, vertices));
    corner[1] = transform_point(pixel_from_model, vload3(vertex.y, vertices));
    corner[2] = transform_point(pixel_from_model, vload3(vertex.z, vertices));
    const int count = clip_triangle(near_m, corner);
    for (int i = 2; i < count; i++) {
        float4 depths;
        const int4 a = on_subpixel(corner[0]), b = on_subpixel(corner[i - 1]), c = on_subpixel(corner[i]);
        const int8 piece = make_piece(a, b, c, triangle, size, &depths);
        if (piece.s6 < 0) continue;
        write_piece(piece, depths, atomic_inc(counts), room, size, counts + 2, corners, inverse_depths);
    }
}

// Updates the nearest depth of the pixels that a small piece covers, bits SMALL y + x from `corner` on. Returns the pixels
// where it is the nearest so far.
static ulong note_nearest(const ulong covered, const int2 corner, const int2 size, const long8 edges,
                          const float4 depths, global uint *nearest) {
    ulong shown = covered;
    for (ulong left = covered; left; left &= left - 1) {
        const int bit = lowest_bit(left);
        const int2 pixel = (int2)(bit % SMALL, bit / SMALL);
        const uint depth = depth_at(edges, depths, pixel);
        const int index = (corner.y + pixel.y) * size.x + corner.x + pixel.x;
        if (atomic_max(&nearest[index], depth) > depth) shown ^= left & -left;
    }
    return shown;
}

static void write_fragments(ulong left, const int8 piece, const int2 size, const float4 depths, int place,
                            const int room, global int4 *fragments) {
    const int2 corner = pixel_bounds(piece, size).xy;
    const long8 edges = edges_of(piece, corner);
    for (; left && place < room; left &= left - 1, place++) {
        const int bit = lowest_bit(left);
        const int2 pixel = (int2)(bit % SMALL, bit / SMALL);
        const int index = (corner.y + pixel.y) * size.x + corner.x + pixel.x;
        fragments[place] = (int4)(index, (int)depth_at(edges, depths, pixel), piece.s6, 0);
    }
}

// The piece of a triangle that needs no clipping; NO_PIECE for others. `behind`: all corners are behind the camera; `whole`:
// no corner must be clipped.
static int8 piece_of(const int8 object, const int triangle, const int2 size, const global int *triangles,
                     const global int4 *projected, float4 *depths, bool *whole, bool *behind) {
    const int3 vertex = vload3(object.s1 + triangle, triangles) + object.s6;
    const int4 a = projected[vertex.x], b = projected[vertex.y], c = projected[vertex.z];
    *whole = a.z != 0 && b.z != 0 && c.z != 0;
    *behind = a.w && b.w && c.w;
    return *whole ? make_piece(a, b, c, object.s5 + triangle, size, depths) : NO_PIECE;
}

// For every triangle of the objects in view, writes its pieces, in any order, and counts them in the tiles they touch, or
// writes its fragments that nothing nearer hides yet. Pieces and fragments beyond the capacity are only counted.
// room: capacity of pieces and of fragments.
kernel __attribute__((reqd_work_group_size(CHUNK, 1, 1)))
void setup_triangles(const int2 size, const int2 room, const global int2 *chunks, const global int8 *objects,
                     const global float16 *matrices, const float near_m, const global float *vertices,
                     const global int *triangles, const global int4 *projected, global int *counts,
                     global int8 *corners, global float4 *inverse_depths, global uint *nearest,
                     global int4 *fragments) {
    local int kept[2], first[2];
    const int2 chunk = chunks[group_number()];
    const int8 object = objects[chunk.x];
    const int item = get_local_id(0), triangle = chunk.y + item;
    if (item < 2) kept[item] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    int8 piece = NO_PIECE;
    float4 depths = (float4)(0.0f);
    if (triangle < object.s4) {
        bool whole, behind;
        piece = piece_of(object, triangle, size, triangles, projected, &depths, &whole, &behind);
        if (!whole && !behind)
            write_clipped(matrices[3 * chunk.x], vertices + 3 * object.s0, vload3(object.s1 + triangle, triangles),
                          near_m, object.s5 + triangle, room.x, size, counts, corners, inverse_depths);
    }
    const int4 bounds = pixel_bounds(piece, size);
    const bool small = is_small(bounds);
    ulong shown = 0;
    int place = 0;
    if (piece.s6 >= 0 && small) {
        shown = small_coverage(piece, bounds.xy, bounds.zw - bounds.xy);
        if (shown) {
            const long8 edges = edges_of(piece, bounds.xy);
            depths /= (float)edges.s6;
            shown = note_nearest(shown, bounds.xy, size, edges, depths, nearest);
            if (shown) place = atomic_add(&kept[1], (int)popcount(shown));
        }
    } else if (piece.s6 >= 0) {
        place = atomic_inc(&kept[0]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 2) first[item] = kept[item] > 0 ? atomic_add(&counts[item], kept[item]) : 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (piece.s6 >= 0 && !small)
        write_piece(piece, depths, first[0] + place, room.x, size, counts + 2, corners, inverse_depths);
    if (shown) write_fragments(shown, piece, size, depths, first[1] + place, room.y, fragments);
}

// As settle_fragments, from the triangles themselves, if there were more fragments than `room`.
kernel __attribute__((reqd_work_group_size(CHUNK, 1, 1)))
void settle_triangles(const int2 size, const int room, const global int *counts, const global int2 *chunks,
                      const global int8 *objects, const global int *triangles, const global int4 *projected,
                      const global uint *nearest, global int *visible) {
    const int2 chunk = chunks[group_number()];
    const int8 object = objects[chunk.x];
    const int triangle = chunk.y + get_local_id(0);
    if (counts[1] <= room || triangle >= object.s4) return;
    bool whole, behind;
    float4 depths = (float4)(0.0f);
    const int8 piece = piece_of(object, triangle, size, triangles, projected, &depths, &whole, &behind);
    const int4 bounds = pixel_bounds(piece, size);
    if (piece.s6 < 0 || !is_small(bounds)) return;
    const long8 edges = edges_of(piece, bounds.xy);
    depths /= (float)edges.s6;
    for (ulong left = small_coverage(piece, bounds.xy, bounds.zw - bounds.xy); left; left &= left - 1) {
        const int2 pixel = (int2)(lowest_bit(left) % SMALL, lowest_bit(left) / SMALL);
        const int index = (bounds.y + pixel.y) * size.x + bounds.x + pixel.x;
        if (depth_at(edges, depths, pixel) == nearest[index]) atomic_min(&visible[index], piece.s6);
    }
}

// Exclusive running sum over the tiles' counts, by one work-group. starts[tiles] is the total, followed by the
// numbers of pieces and fragments, so that the host reads all at once.
// A tile lists at most `most` pieces; testing more would take too long anyway.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1)))
void scan_tiles(const int tiles, const int most, const global int *counts, global int *starts) {
    const global int *tile_counts = counts + 2;
    local int sums[SCAN_ITEMS];
    const int item = get_local_id(0);
    const int share = (tiles + SCAN_ITEMS - 1) / SCAN_ITEMS;
    const int begin = min(item * share, tiles), end = min(begin + share, tiles);
    int sum = 0;
    for (int tile = begin; tile < end; tile++) sum += min(tile_counts[tile], most);
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    int before = 0;
    for (int i = 0; i < item; i++) before += sums[i];
    for (int tile = begin; tile < end; tile++) {
        starts[tile] = before;
        before += min(tile_counts[tile], most);
    }
    if (item == SCAN_ITEMS - 1) {
        starts[tiles] = before;
        starts[tiles + 1] = counts[0];
        starts[tiles + 2] = counts[1];
    }
}

// Lists a piece in the tiles it touches.
static void list_piece(const int index, const int8 piece, const int2 size, const global int *starts, global int *counts,
                       global int *entries) {
    const int4 tiles = pixel_bounds(piece, size) / TILE;
    for (int y = tiles.y; y <= tiles.w; y++)
        for (int x = tiles.x; x <= tiles.z; x++) {
            if (!touches_tile(piece, tiles, (int2)(x, y))) continue;
            const int tile = y * tile_columns(size) + x, slot = starts[tile] + atomic_dec(&counts[2 + tile]) - 1;
            if (slot < starts[tile + 1]) entries[slot] = index;
        }
}

// Lists all pieces, each of `items` work-items every items-th, unless the entries are more than `room`. Counts the tiles
// down to 0; the order within a tile does not matter.
kernel void fill_tiles(const int items, const int tiles, const int room, const int2 size, const global int8 *corners,
                       const global int *starts, global int *counts, global int *entries) {
    const int pieces = starts[tiles] <= room ? starts[tiles + 1] : 0;
    for (int index = get_global_id(0); index < pieces; index += items)
        list_piece(index, corners[index], size, starts, counts, entries);
}

static inline int2 pixel_of(const int bit) { return (int2)(bit % TILE, bit / TILE); }

// One work-group a tile of `region`. It processes up to 64 entries at a time: if there are few, each pixel tests
// those that cover it; if there are many, they are mostly small, and each entry visits the pixels it covers:
// first the nearest depth of each pixel is found, then the lowest triangle that has it. Where the entries were more than
// `room`, nothing is listed, and all pieces are processed.
// -> visible: the triangle of each pixel, the lower index of two equally near ones; NOBODY where a fragment is
// nearer or there is none. nearest: of fragments and pieces.
kernel __attribute__((reqd_work_group_size(TILE * TILE, 1, 1)))
void raster_tiles(const int2 size, const int4 region, const int tiles, const int room, const global int8 *corners,
                  const global float4 *inverse_depths, const global int *starts,
                  const global int *entries, global uint *nearest, global int *visible) {
    local ulong masks[TILE * TILE];
    local long8 edges[TILE * TILE];
    local float4 depths[TILE * TILE];
    local int numbers[TILE * TILE];
    local uint best[TILE * TILE];
    local int winners[TILE * TILE];
    const int item = get_local_id(0), columns = region.z - region.x;
    const int2 place = region.xy + (int2)(group_number() % columns, group_number() / columns);
    const int tile = place.y * tile_columns(size) + place.x;
    const int2 origin = TILE * place;
    const int2 pixel = origin + pixel_of(item);
    const bool inside = pixel.x < size.x && pixel.y < size.y;
    const int index = pixel.y * size.x + pixel.x;
    best[item] = inside ? nearest[index] : 0;
    winners[item] = NOBODY;
    const bool is_listed = starts[tiles] <= room;
    const int first = is_listed ? starts[tile] : 0, end = is_listed ? starts[tile + 1] : starts[tiles + 1];
    for (int begin = first; begin < end; begin += TILE * TILE) {
        const int count = min(end - begin, TILE * TILE);
        if (item < count) {
            const int entry = is_listed ? entries[begin + item] : begin + item;
            const int8 piece = corners[entry];
            masks[item] = coverage(piece, origin, size);
            edges[item] = edges_of(piece, origin);
            depths[item] = inverse_depths[entry] / (float)edges[item].s6;
            numbers[item] = piece.s6;
        }
        const uint before = best[item];
        barrier(CLK_LOCAL_MEM_FENCE);
        // All pass every barrier, whichever way is taken: PoCL's plain loops go wrong on barriers under a condition.
        const bool few = count <= FEW;
        const ulong own = !few && item < count ? masks[item] : 0;
        for (int i = 0; i < (few ? count : 0); i++) {
            if (!((masks[i] >> item) & 1)) continue;
            const uint depth = depth_at(edges[i], depths[i], pixel_of(item));
            if (depth < best[item] || (depth == best[item] && numbers[i] > winners[item])) continue;
            best[item] = depth;
            winners[item] = numbers[i];
        }
        for (ulong left = own; left; left &= left - 1) {
            const int bit = lowest_bit(left);
            const uint depth = depth_at(edges[item], depths[item], pixel_of(bit));
            atomic_max(&best[bit], depth);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!few && best[item] > before) winners[item] = NOBODY;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (ulong left = own; left; left &= left - 1) {
            const int bit = lowest_bit(left);
            if (depth_at(edges[item], depths[item], pixel_of(bit)) != best[bit]) continue;
            atomic_min(&winners[bit], numbers[item]);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (inside) {
        nearest[index] = best[item];
        visible[index] = winners[item];
    }
}

// Writes the triangles of the nearest fragments; of several at one pixel, the lowest index. Each of `items` work-items
// takes every items-th fragment, none if there were more than `room`.
kernel void settle_fragments(const int items, const int room, const global int *counts, const global int4 *fragments,
                             const global uint *nearest, global int *visible) {
    const int count = counts[1] <= room ? counts[1] : 0;
    for (int index = get_global_id(0); index < count; index += items) {
        const int4 fragment = fragments[index];
        if ((uint)fragment.y == nearest[fragment.x]) atomic_min(&visible[fragment.x], fragment.z);
    }
}

static float3 textured(const Textures textures, const int texture, const float2 a, const float2 ab, const float2 ac,
                       const float2 share, const float4 changes, const int most_probes) {
    const Footprint footprint = {a + share.x * ab + share.y * ac, changes.x * ab + changes.y * ac,
                                 changes.z * ab + changes.w * ac};
    return sample_texture(textures, texture, footprint, most_probes);
}

// Index of a triangle's object: the last row that begins at or before the triangle's index.
static int object_of(const int triangle, const int count, const global int8 *objects) {
    int low = 0, high = count;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (objects[middle].s5 <= triangle) low = middle;
        else high = middle;
    }
    return low;
}

// The surface that each pixel shows: the object's index, -1 where there is none; position in volume metres, unit
// normal, linear base colour, and roughness, metalness and 0, each with w = 1, all 0 where there is none.
// `attributes` [v, 3] float4: normal; linear base colour; texture coordinates of base colour and of roughness and
// metalness. `materials` [m] float4: roughness, metalness, numbers of the textures of base colour and of roughness (G)
// and metalness (B), -1 for none. `material_of` [t] a triangle's, in its mesh.
// `visible`, and the tiles of `region` in which it is known, are of a picture `parts` times as large along either side, whose pixel
// (parts u, parts v) has the centre of pixel (u, v).
// The ray of pixel (u, v) of that picture is model_from_pixel's column 3 + t * its columns 0 to 2 times (u, v, 1), with t the depth;
// its last row is not part of the ray: it maps a model point to its depth.
// Writes the pixels `around` (x0 y0 x1 y1, half-open).
kernel void shade_surface(const SurfaceParameters parameters, const global int *visible, const global int8 *objects,
                          const global float16 *matrices, const global float *vertices, const global int *triangles,
                          const global float4 *attributes, const global int *material_of,
                          const global float4 *materials, const global int4 *texture_table, const global int4 *levels,
                          const global uchar4 *texels, const global float *values, global int *object_index,
                          global float4 *position, global float4 *normal, global float4 *base_color,
                          global float4 *surface) {
    const int4 around = parameters.around, region = parameters.region;
    const int2 pixel = around.xy + (int2)(get_global_id(0), get_global_id(1));
    if (pixel.x >= around.z || pixel.y >= around.w) return;
    const int index = pixel.y * parameters.width + pixel.x;
    const int2 part = pixel * parameters.parts, tile = part / TILE;
    const bool drawn = tile.x >= region.x && tile.y >= region.y && tile.x < region.z && tile.y < region.w;
    const int shown = drawn ? visible[part.y * parameters.parts * parameters.width + part.x] : NOBODY;
    if (shown == NOBODY) {
        object_index[index] = -1;
        position[index] = normal[index] = base_color[index] = surface[index] = (float4)(0.0f);
        return;
    }
    const int number = object_index[index] = object_of(shown, parameters.object_count, objects);
    const int8 object = objects[number];
    const float16 model_from_pixel = matrices[3 * number + 1];
    const int triangle = object.s1 + shown - object.s5;
    const int3 v = vload3(triangle, triangles) + object.s0;
    const float3 a = vload3(v.x, vertices), ab = vload3(v.y, vertices) - a, ac = vload3(v.z, vertices) - a;
    const float3 direction = transform_vector(model_from_pixel, (float3)(part.x, part.y, 1.0f));
    const float3 hit = intersect_plane(a, ab, ac, model_from_pixel.s37b, direction);
    const float3 share = shares_inside(hit), point = point_on_ray(model_from_pixel, a, ab, ac, direction, hit.z);
    const global float4 *at_a = attributes + 3 * v.x, *at_b = attributes + 3 * v.y, *at_c = attributes + 3 * v.z;
    const float4 mean_normal = share.x * at_a[0] + share.y * at_b[0] + share.z * at_c[0];
    float4 color = share.x * at_a[1] + share.y * at_b[1] + share.z * at_c[1];
    const float4 material = materials[object.s2 + material_of[triangle]];
    float2 roughness_metalness = material.xy;
    if (material.z >= 0.0f || material.w >= 0.0f) {
        const Textures textures = {texture_table, levels, texels, values};
        const float4 changes =
            parameters.parts * share_changes(ab, ac, model_from_pixel, model_from_pixel.s37b - a, direction);
        const float4 uv = at_a[2], to_b = at_b[2] - uv, to_c = at_c[2] - uv;
        if (material.z >= 0.0f)
            color.xyz *= textured(textures, (int)material.z, uv.xy, to_b.xy, to_c.xy, share.yz, changes, COLOR_PROBES);
        if (material.w >= 0.0f)
            roughness_metalness *=
                textured(textures, (int)material.w, uv.zw, to_b.zw, to_c.zw, share.yz, changes, 1).yz;
    }
    const float3 to_camera = -direction / sqrt(dot(direction, direction));
    const float3 seen_normal = facing_camera(mean_normal.xyz, cross(ab, ac), to_camera);
    const float16 volume_from_model = matrices[3 * number + 2];
    position[index] = (float4)(transform_point(volume_from_model, point), 1.0f);
    const float3 turned = transform_vector(volume_from_model, seen_normal);
    normal[index] = (float4)(turned / sqrt(dot(turned, turned)), 1.0f);
    base_color[index] = (float4)(color.xyz, 1.0f);
    surface[index] = (float4)(roughness_metalness, 0.0f, 1.0f);
}
