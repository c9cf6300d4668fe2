// Draws triangle meshes into the virtual geometry buffer (the rasterised buffer of section 7.2, fig. 7.5).
//
// setup_triangles -> scan_tiles -> fill_tiles -> raster_tiles -> clear_uncovered -> shade_surface, once per object the
// first and the last. Screen positions are snapped to 1/256 pixel and edges evaluated in exact integers, so that
// triangles sharing an edge cover each pixel centre once (top-left rule). Pixel centres lie at integers.
//
// A piece is a triangle after clipping. `corners` [pieces] int8: x0 y0 x1 y1 x2 y2 in subpixels, turned to positive
// area; the triangle's number among all objects, -1 for no piece; the object's index.
// `inverse_depths` [pieces] float4: 1 / z at the corners, 1/metre.
#include "clip.clh"

// The same vertex must land on the same subpixel in every triangle that shares it.
#pragma OPENCL FP_CONTRACT OFF

#define TILE 8
#define SUBPIXELS 256
#define SCAN_ITEMS 256

static inline int2 tile_grid(int width, int height)
{
    return (int2)((width + TILE - 1) / TILE, (height + TILE - 1) / TILE);
}

// Pixel centres inside the bounds of a piece: x0 y0 x1 y1, inclusive, cut to the picture; empty if x0 > x1 or y0 > y1.
static inline int4 pixel_bounds(int8 c, int width, int height)
{
    const int2 low = (int2)(min(c.s0, min(c.s2, c.s4)), min(c.s1, min(c.s3, c.s5)));
    const int2 high = (int2)(max(c.s0, max(c.s2, c.s4)), max(c.s1, max(c.s3, c.s5)));
    return (int4)(max((low + SUBPIXELS - 1) >> 8, 0), min(high >> 8, (int2)(width - 1, height - 1)));
}

// Twice the signed area of a, b and a pixel centre, in subpixels squared: positive where the pixel is inside.
static inline long edge_at(int ax, int ay, int bx, int by, int2 pixel)
{
    return (long)(bx - ax) * (pixel.y * SUBPIXELS - ay) - (long)(by - ay) * (pixel.x * SUBPIXELS - ax);
}

// 0 for a top or left edge, which owns the pixel centres on it, else -1.
static inline long fill_bias(int ax, int ay, int bx, int by)
{
    return by < ay || (by == ay && bx > ax) ? 0 : -1;
}

// edge_at for the edges opposite to corners 0, 1 and 2.
static inline long3 edges_at(int8 c, int2 pixel)
{
    return (long3)(edge_at(c.s2, c.s3, c.s4, c.s5, pixel),
                   edge_at(c.s4, c.s5, c.s0, c.s1, pixel),
                   edge_at(c.s0, c.s1, c.s2, c.s3, pixel));
}

static inline long3 fill_biases(int8 c)
{
    return (long3)(fill_bias(c.s2, c.s3, c.s4, c.s5),
                   fill_bias(c.s4, c.s5, c.s0, c.s1),
                   fill_bias(c.s0, c.s1, c.s2, c.s3));
}

// What edges_at changes by from one pixel to the next in x and in y.
static inline long3 edge_steps_x(int8 c)
{
    return SUBPIXELS * (long3)(c.s3 - c.s5, c.s5 - c.s1, c.s1 - c.s3);
}

static inline long3 edge_steps_y(int8 c)
{
    return SUBPIXELS * (long3)(c.s4 - c.s2, c.s0 - c.s4, c.s2 - c.s0);
}

// False if no pixel centre of the tile can be inside: an edge has all of them on its outer side.
static inline bool touches_tile(int8 c, int2 tile)
{
    const long3 reach = (TILE - 1) * (max(edge_steps_x(c), 0L) + max(edge_steps_y(c), 0L));
    const long3 most = edges_at(c, tile * TILE) + reach;
    return min(most.x, min(most.y, most.z)) >= 0;
}

static inline int2 snapped(float3 point)
{
    return convert_int2_rte(point.xy / point.z * (float)SUBPIXELS);
}

// Writes one piece, turned to positive area; leaves a piece that covers no pixel centre as it was made: empty.
static inline bool write_piece(const float3 *h, int2 ids, int width, int height, global int8 *corners,
                               global float4 *inverse_depths)
{
    const int2 a = snapped(h[0]), b = snapped(h[1]), c = snapped(h[2]);
    const long area = (long)(b.x - a.x) * (c.y - a.y) - (long)(b.y - a.y) * (c.x - a.x);
    const bool turn = area < 0;
    const int8 piece = (int8)(a, turn ? c : b, turn ? b : c, ids);
    const int4 bounds = pixel_bounds(piece, width, height);
    if (area == 0 || bounds.x > bounds.z || bounds.y > bounds.w)
        return false;
    *corners = piece;
    *inverse_depths = 1.0f / (float4)(h[0].z, turn ? h[2].z : h[1].z, turn ? h[1].z : h[2].z, 1.0f);
    return true;
}
