// Surface prediction (KinectFusion; thesis 4.2.1): the zero crossing of the TSDF along each pixel's ray, and its normal.
// Provides bound_rays, raycast, raycast_between, raycast_rest.
#include "camera.clh"
#include "ray_surface.clh"

#define TILE 8
#define SPACING 2         // pixels between rays that are walked from where solid voxels may be
#define LEAST_SLOPE 0.1f  // cosine of a ray and a plane: beyond, a voxel along the ray says little of one across
#define SMOOTH 0.3f       // voxels between the planes that are taken for one surface: what lies amid them is off by .01 in the median, .15 in 1 %;
#define EVEN 0.98f        // and the least length of their mean normal: two that are 23 degrees apart
#define BEFORE 4.0f       // voxels: what two rays that are two voxels apart have seen may slope towards the camera between them

// First and last of four layers of cells that contain one of `cells`; layer i is `first_layer` shifted by i steps.
static inline float2 layers(const ulong cells, const ulong first_layer, const int step) {
    int low = 3, high = 0;
    for (int i = 0; i < 4; i++) {
        if (!(cells & (first_layer << (i * step)))) continue;
        low = min(low, i);
        high = i;
    }
    return (float2)(low, high + 1);
}

// The box around the solid cells of a brick, volume metres.
static inline void solid_box(const ulong cells, const int3 brick, const float voxel_m, float3 *low_m, float3 *size_m) {
    const float2 x = layers(cells, 0x1111111111111111UL, 1), y = layers(cells, 0x000f000f000f000fUL, 4), z = layers(cells, 0xffffUL, 16);
    const float cell_m = 2.0f * voxel_m;
    *low_m = convert_float3(brick) * (BRICK * voxel_m) + cell_m * (float3)(x.s0, y.s0, z.s0);
    *size_m = cell_m * (float3)(x.s1 - x.s0, y.s1 - y.s0, z.s1 - z.s0);
}

// Range of depths in which a tile of TILE x TILE pixels can see a solid voxel: rays are marched only there. One item a
// brick of allocated [count]; nearest, farthest [tile row][tile column]: bits of float metres, which compare like the
// floats; they start as +infinity and 0.
kernel void bound_rays(const int count, const int width, const int height, const int4 bricks, global const int *allocated,
                       global const ulong *solid, const float voxel_m, const float4 intrinsics,
                       const float16 camera_from_volume, global int *nearest, global int *farthest) {
    const int item = get_global_id(0);
    if (item >= count) return;
    const int index = allocated[item];
    if (solid[index] == 0) return;
    const int3 brick = (int3)(index % bricks.x, (index / bricks.x) % bricks.y, index / (bricks.x * bricks.y));
    float3 low, size_m;
    solid_box(solid[index], brick, voxel_m, &low, &size_m);
    const float3 center = transform_point(camera_from_volume, low + 0.5f * size_m);
    if (!may_be_seen(intrinsics, width, height, center, 0.5001f * length(size_m))) return;
    float2 least = (float2)(1e9f), most = (float2)(-1e9f);
    float near = 1e9f, far = 0.0f;
    for (int corner = 0; corner < 8; corner++) {
        const float3 p = low + size_m * (float3)(corner & 1, (corner >> 1) & 1, corner >> 2);
        const float3 in_camera = transform_point(camera_from_volume, p);
        near = fmin(near, in_camera.z);
        far = fmax(far, in_camera.z);
        const float2 pixel = project(intrinsics, (float3)(in_camera.xy, fmax(in_camera.z, 1e-3f)));
        least = fmin(least, pixel);
        most = fmax(most, pixel);
    }
    const int around = near < 1e-2f;  // reaches behind the camera: the pixels of its corners are undefined
    const int2 size = (int2)(width, height);
    const int2 first = around ? (int2)(0) : convert_int2(clamp(least, 0.0f, 1e5f)) / TILE;
    const int2 last = around ? (size - 1) / TILE : min(convert_int2(clamp(most + 1.0f, -1.0f, 1e5f)), size - 1) / TILE;
    if (!around && (most.x < -1.0f || most.y < -1.0f)) return;
    const int columns = (width + TILE - 1) / TILE;
    const int near_bits = as_int(fmax(near, 0.0f)), far_bits = as_int(far);
    for (int y = first.y; y <= last.y; y++) {
        for (int x = first.x; x <= last.x; x++) {
            atomic_min(nearest + y * columns + x, near_bits);
            atomic_max(farthest + y * columns + x, far_bits);
        }
    }
}

// Rays through pixels, and where on them, in voxels, solid voxels may be.
typedef struct {
    Rays rays;
    floatn begin;
    floatn end;
} View;

// Through the pixels (x, y), where solid voxels lie at depths from `near` to `far`, metres.
static inline View view_through(const Volume volume, const float4 intrinsics, const float16 volume_from_camera, const floatn x,
                                const floatn y, const floatn near, const floatn far) {
    const float16 m = volume_from_camera;
    const floatn u = (x - intrinsics.s2) / intrinsics.s0, v = (y - intrinsics.s3) / intrinsics.s1;
    const floatn length = sqrt(u * u + (v * v + 1.0f));
    const floatn shorten = 1.0f / length;
    const Vectors direction = {(m.s0 * u + (m.s1 * v + m.s2)) * shorten, (m.s4 * u + (m.s5 * v + m.s6)) * shorten,
                               (m.s8 * u + (m.s9 * v + m.sa)) * shorten};
    View view;
    view.rays = make_rays(m.s37b / volume.voxel_m, direction);
    clip_rays(volume, view.rays, &view.begin, &view.end);
    const floatn per_depth = length / volume.voxel_m;
    view.begin = fmax(view.begin, near * per_depth);
    view.end = fmin(view.end, far * per_depth);
    return view;
}

// Through the pixels x, x + SPACING, ... of row y; nearest, farthest: of bound_rays.
static inline View view_of_row(const Volume volume, const float4 intrinsics, const float16 volume_from_camera, const int width,
                               const int x, const int y, const float greatest_depth_m, global const int *nearest,
                               global const int *farthest) {
    const int row = y / TILE * ((width + TILE - 1) / TILE), last = min(x + SPACING * (LANES - 1), width - 1) / TILE;
    int near = as_int(INFINITY), far = 0;
    for (int column = x / TILE; column <= last; column++) {
        near = min(near, nearest[row + column]);
        far = max(far, farthest[row + column]);
    }
    return view_through(volume, intrinsics, volume_from_camera, x + SPACING * LANE_NUMBERS, (floatn)((float)y), (floatn)(as_float(near)),
                        (floatn)(fmin(greatest_depth_m, as_float(far))));
}

// Writes what `count` pixels see: distances in voxels (0 where nothing), unit normals.
static inline void store_surface(const Volume volume, const Rays rays, const floatn t, const Vectors facing, const int count,
                                 const int *pixels, global float4 *positions, global float4 *normals) {
    const Vectors point = point_at(rays, t);
    float hits[LANES], px[LANES], py[LANES], pz[LANES], nx[LANES], ny[LANES], nz[LANES];
    STORE_LANES(t, hits);
    STORE_LANES(point.x, px);
    STORE_LANES(point.y, py);
    STORE_LANES(point.z, pz);
    STORE_LANES(facing.x, nx);
    STORE_LANES(facing.y, ny);
    STORE_LANES(facing.z, nz);
    for (int lane = 0; lane < count; lane++) {
        const float hit = hits[lane] > 0.0f ? 1.0f : 0.0f;
        positions[pixels[lane]] = (float4)(hit * volume.voxel_m * (float3)(px[lane], py[lane], pz[lane]), hit);
        normals[pixels[lane]] = (float4)(hit * (float3)(nx[lane], ny[lane], nz[lane]), hit);
    }
}

// The pixels x, x + SPACING, ... of row y. Returns how many are inside the picture.
static inline int pixels_of_row(const int width, const int x, const int y, int *pixels) {
    for (int lane = 0; lane < LANES; lane++) pixels[lane] = y * width + x + SPACING * lane;
    return min(LANES, (width - x + SPACING - 1) / SPACING);
}

#define VIEW_PARAMETERS                                                                                                            \
    const int width, const int height, VOLUME_PARAMETERS, const float4 intrinsics, const float16 volume_from_camera,               \
        const float greatest_depth_m, global const int *nearest, global const int *farthest

// Volume and view -> positions [h][w] (volume space metres, w = 1 surface, 0 none), normals [h][w] (unit, towards free
// space, w likewise), at every SPACING-th pixel of every SPACING-th row. One item LANES such pixels of a row.
kernel void raycast(VIEW_PARAMETERS, global float4 *positions, global float4 *normals) {
    const int x = SPACING * get_global_id(0) * LANES;
    const int y = SPACING * get_global_id(1);
    if (x >= width || y >= height) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const View view = view_of_row(volume, intrinsics, volume_from_camera, width, x, y, greatest_depth_m, nearest, farthest);
    Vectors facing = {0.0f, 0.0f, 0.0f};
    const floatn t = find_surface(volume, view.rays, view.begin, view.end, &facing);
    int pixels[LANES];
    const int count = pixels_of_row(width, x, y, pixels);
    store_surface(volume, view.rays, t, facing, count, pixels, positions, normals);
}

// What the rays of pixels around say of rays between them; voxels.
typedef struct {
    floatn nearest, farthest;  // where the rays meet the planes of surface that was seen there
    floatn first;              // distance of the nearest point that was seen there
    floatn inverses;           // sum of 1 / distance of the points
    Vectors normal;            // sum of the normals of these planes
    intn met;                  // all planes were met
    intn seen;                 // at least one of them has seen surface
    intn inside;               // all are pixels of the picture
} Around;

// What LANES + 1 rays of a row of those that were walked have seen, from the camera: normals, distances of the planes and of the points from
// it in voxels; masks of those that have seen surface, and of those inside the picture.
typedef struct {
    float nx[LANES + 1], ny[LANES + 1], nz[LANES + 1], height[LANES + 1], away[LANES + 1];
    int seen[LANES + 1], inside[LANES + 1];
} Walked;

// Of the pixels x, x + SPACING, ... of row y.
static inline void load_walked(const float3 origin, const float voxel_m, const int2 size, const int x, const int y,
                               global const float4 *positions, global const float4 *normals, Walked *walked) {
    for (int i = 0; i <= LANES; i++) {
        const int at = x + SPACING * i, inside = at < size.x && y < size.y, pixel = inside ? y * size.x + at : 0;
        const float4 normal = inside ? normals[pixel] : (float4)(0.0f);
        const float3 offset = positions[pixel].xyz / voxel_m - origin;
        walked->height[i] = dot(offset, normal.xyz);
        walked->away[i] = sqrt(dot(offset, offset));
        walked->nx[i] = normal.x, walked->ny[i] = normal.y, walked->nz[i] = normal.z;
        walked->seen[i] = -(normal.w > 0.0f);
        walked->inside[i] = -inside;
    }
}

// Adds LANES of them, from the first or from the second on.
static inline void look_beside(const Rays rays, const Walked *walked, const int from, Around *around) {
    const intn is_seen = LOAD_LANES(walked->seen + from);
    const Vectors normal = {LOAD_LANES(walked->nx + from), LOAD_LANES(walked->ny + from), LOAD_LANES(walked->nz + from)};
    const floatn towards = normal.x * rays.direction.x + normal.y * rays.direction.y + normal.z * rays.direction.z;
    const intn meets = is_seen & MASK(towards < -LEAST_SLOPE);
    const floatn t = LOAD_LANES(walked->height + from) / (meets ? towards : -1.0f);
    around->nearest = meets ? fmin(around->nearest, t) : around->nearest;
    around->farthest = meets ? fmax(around->farthest, t) : around->farthest;
    const floatn away = LOAD_LANES(walked->away + from);
    around->first = is_seen ? fmin(around->first, away) : around->first;
    around->inverses += 1.0f / (meets ? away : 1.0f);
    around->normal.x += normal.x, around->normal.y += normal.y, around->normal.z += normal.z;
    around->met &= meets;
    around->seen |= is_seen;
    around->inside &= LOAD_LANES(walked->inside + from);
}

#define TRIES 3             // where surface is looked for first, along rays of the rest
#define TURNS (LANES > 1 ? 16 : 1)  // of LANES rays that are done together: one in twenty of the rest is walked
#define ENTRY (2 + TRIES)   // of `rest`: the pixel, then as bits of float voxels where its ray is tried, and where it begins to be walked

// Adds rays to the rest: `left` of the `count` pixels.
static inline void leave(const intn left, const int count, const int *pixels, const floatn begin, const floatn *tries, global int *rest) {
    int is_left[LANES], total = 0;
    float values[ENTRY - 1][LANES];
    STORE_LANES(left, is_left);
    for (int lane = 0; lane < count; lane++) total += is_left[lane] != 0;
    if (total == 0) return;
    for (int i = 0; i < TRIES; i++) STORE_LANES(tries[i], values[i]);
    STORE_LANES(begin, values[TRIES]);
    global int *entry = rest + 1 + ENTRY * atomic_add(rest, total);
    for (int lane = 0; lane < count; lane++) {
        if (!is_left[lane]) continue;
        entry[0] = pixels[lane];
        for (int i = 0; i < ENTRY - 1; i++) entry[1 + i] = as_int(values[i][lane]);
        entry += ENTRY;
    }
}

// The rays of pixels x, x + SPACING, ... of row y, between `others` that were walked. focal: the lesser of both axes, pixels.
static inline void cast_between(const Volume volume, const View view, const Around around, const int others, const float focal,
                                const int width, const int x, const int y, global float4 *positions, global float4 *normals,
                                global int *rest) {
    const Vectors sum = around.normal;
    const floatn length = sqrt(sum.x * sum.x + sum.y * sum.y + sum.z * sum.z);
    const intn all = MASK(view.begin < view.end), empty = around.inside & ~around.seen & MASK(view.end < focal);
    const intn smooth = around.met & MASK(around.farthest - around.nearest < SMOOTH) & MASK(around.farthest < focal) &
                        MASK(length > EVEN * others);
    const floatn scale = 1.0f / (smooth ? length : 1.0f);
    const Vectors facing = {sum.x * scale, sum.y * scale, sum.z * scale};
    int pixels[LANES];
    const int count = pixels_of_row(width, x, y, pixels);
    // Surface that bulges lies half-way between the planes and the straight line through the points, as a cubic does.
    const floatn between = 0.25f * (around.nearest + around.farthest) + 0.5f * others / around.inverses;
    store_surface(volume, view.rays, smooth ? between : 0.0f, facing, count, pixels, positions, normals);
    const intn bounded = around.inside & MASK(around.first < focal);
    const floatn begin = bounded ? fmax(view.begin, around.first - BEFORE) : view.begin;
    const floatn candidates[TRIES] = {around.nearest, around.first, around.farthest};
    floatn tries[TRIES];
    for (int i = 0; i < TRIES; i++) {
        const intn near = around.inside & around.seen & MASK(candidates[i] > 0.0f) & MASK(candidates[i] < focal);
        tries[i] = near ? candidates[i] : 0.0f;
    }
    leave(all & ~empty & ~smooth, count, pixels, begin, tries, rest);
}

// The pixels that `raycast` has left out, three of each square of four. As long as a ray is within a voxel of those beside it, the volume
// holds nothing that they would miss. So where they have seen nothing, it sees nothing, and where it meets the planes that they have seen
// at one place, that is what it sees. -> rest: the number of others, which is 0 before, then an entry of each: as at a silhouette, it is
// tried where the ray meets the nearest of the planes, at the distance of the nearest point that was seen, and at the farthest of them (0:
// not there); it is walked from shortly before what was seen beside it.
kernel void raycast_between(VIEW_PARAMETERS, global float4 *positions, global float4 *normals, global int *rest) {
    const int left = SPACING * get_global_id(0) * LANES, top = SPACING * get_global_id(1);
    if (left >= width || top >= height) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const float3 origin = volume_from_camera.s37b / volume.voxel_m;
    Walked rows[2];
    for (int i = 0; i < 2; i++)
        load_walked(origin, volume.voxel_m, (int2)(width, height), left, top + i * SPACING, positions, normals, rows + i);
    for (int which = 0; which < 3; which++) {
        const int dx = which != 1, dy = which != 0, x = left + dx, y = top + dy;
        if (x >= width || y >= height) continue;
        const View view = view_of_row(volume, intrinsics, volume_from_camera, width, x, y, greatest_depth_m, nearest, farthest);
        const intn all = MASK(view.begin < view.end), none = MASK(view.begin != view.begin);
        Around around = {1e9f, 0.0f, 1e9f, 0.0f, {0.0f, 0.0f, 0.0f}, all, none, all};
        for (int i = 0; i <= dy; i++)
            for (int j = 0; j <= dx; j++) look_beside(view.rays, rows + i, j, &around);
        cast_between(volume, view, around, (dx + 1) * (dy + 1), fmin(intrinsics.s0, intrinsics.s1), width, x, y, positions, normals, rest);
    }
}

// LANES rays of the rest.
typedef struct {
    int pixels[LANES];
    View view;
    floatn again;  // where to try
} RestRays;

// Those with these numbers; again: for the attempt of this number, or where to begin to walk.
static inline RestRays load_rest(const Volume volume, const float4 intrinsics, const float16 volume_from_camera, const int width,
                                 const float greatest_depth_m, global const int *farthest, global const int *rest, const int *numbers,
                                 const int attempt) {
    RestRays rays;
    float x[LANES], y[LANES], far[LANES], again[LANES];
    const int columns = (width + TILE - 1) / TILE;
    for (int lane = 0; lane < LANES; lane++) {
        global const int *entry = rest + 1 + ENTRY * numbers[lane];
        const int pixel = entry[0], row = pixel / width, col = pixel % width;
        rays.pixels[lane] = pixel;
        x[lane] = col, y[lane] = row;
        far[lane] = fmin(greatest_depth_m, as_float(farthest[row / TILE * columns + col / TILE]));
        again[lane] = as_float(entry[1 + attempt]);
    }
    rays.view = view_through(volume, intrinsics, volume_from_camera, LOAD_LANES(x), LOAD_LANES(y), 0.0f, LOAD_LANES(far));
    rays.again = LOAD_LANES(again);
    return rays;
}

// `count` rays in `rest` from the `first` on, at most TURNS * LANES. All are tried at the first place; those that meet nothing there move
// together to be tried at the next, and are walked in the end. Which are done together does not matter to any of them.
static void cast_rest(const Volume volume, const float4 intrinsics, const float16 volume_from_camera, const int width,
                      const float greatest_depth_m, global const int *farthest, global const int *rest, const int first, int count,
                      global float4 *positions, global float4 *normals) {
    int looking[TURNS * LANES + LANES];
    for (int i = 0; i < count; i++) looking[i] = first + i;
    for (int attempt = 0; attempt <= TRIES; attempt++) {
        int missed = 0;
        for (int done = 0; done < count; done += LANES) {
            const int some = min(count - done, LANES);
            for (int i = some; i < LANES; i++) looking[done + i] = looking[done];
            const RestRays rays = load_rest(volume, intrinsics, volume_from_camera, width, greatest_depth_m, farthest, rest, looking + done,
                                            attempt);
            Vectors facing = {0.0f, 0.0f, 0.0f};
            const floatn t = attempt < TRIES ? settle_near(volume, rays.view.rays, rays.again, MASK(rays.again > 0.0f), &facing)
                                             : find_surface(volume, rays.view.rays, rays.again, rays.view.end, &facing);
            store_surface(volume, rays.view.rays, t, facing, some, rays.pixels, positions, normals);
            int misses[LANES];
            STORE_LANES(MASK(t == 0.0f), misses);
            for (int lane = 0; lane < some; lane++)
                if (misses[lane]) looking[missed++] = looking[done + lane];
        }
        count = missed;
    }
}

// The rays in `rest`: each of `items` work-items does the same number, in whole LANES.
kernel void raycast_rest(VIEW_PARAMETERS, const int items, global const int *rest, global float4 *positions, global float4 *normals) {
    const int share = ((rest[0] + items - 1) / items + LANES - 1) / LANES * LANES;
    const int begin = get_global_id(0) * share, end = min(begin + share, rest[0]);
    const Volume volume = VOLUME_OF_PARAMETERS;
    for (int first = begin; first < end; first += TURNS * LANES)
        cast_rest(volume, intrinsics, volume_from_camera, width, greatest_depth_m, farthest, rest, first, min(end - first, TURNS * LANES),
                  positions, normals);
}
