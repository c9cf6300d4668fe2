// Surface prediction (KinectFusion; thesis 4.2.1): the zero crossing of the TSDF along each pixel's ray, and its normal.
// Provides bound_rays, raycast, raycast_between.
#include "camera.clh"
#include "field.clh"
#include "rays.clh"

#define TILE 8
#define LEAST_SLOPE 0.1f  // cosine of a ray and a plane: beyond, a voxel along the ray says little of one across
#define SMOOTH 0.3f      // voxels between the planes that are taken for one surface,
#define CLOSE 0.1f       // and from these to its crossing: the error of a Newton step that long is a hundredth of a voxel
#define BEFORE 4.0f       // voxels: what two rays that are two voxels apart have seen may slope towards the camera between them

#ifndef SPACING
#error SPACING must be defined: pixels between rays that are walked from where solid voxels may be, 1 or 2
#endif

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

// Steps in voxels along rays to where the field falls through zero (Newton); 0 in `falls` where it does not, or is unseen.
static inline floatn newton_step(const Rays rays, const Field field, const float truncation_voxels, intn *falls) {
    const floatn slope = field.slope.x * rays.direction.x + field.slope.y * rays.direction.y + field.slope.z * rays.direction.z;
    *falls = field.seen & MASK(slope * truncation_voxels <= -0.05f);
    return -field.tsdf / (*falls ? slope : 1.0f);
}

// Distances in voxels near `t` at which rays cross a surface that faces them, by a Newton step of at most a voxel; 0 for rays outside
// `asked` and where there is none. -> facing: unit normals of those that do.
static inline floatn cross_near(const Volume volume, const Rays rays, const floatn t, const intn asked, Vectors *facing) {
    intn falls;
    Vectors g;
    const Field there = sample_surface(volume, point_at(rays, asked ? t : 1.0f), &g);
    const floatn step = newton_step(rays, there, volume.truncation_m / volume.voxel_m, &falls);
    const floatn steepness = sqrt(g.x * g.x + g.y * g.y + g.z * g.z);
    const floatn towards = g.x * rays.direction.x + g.y * rays.direction.y + g.z * rays.direction.z;
    const intn faces = asked & falls & MASK(fabs(step) < 1.0f) & MASK(t + step > 0.0f) & MASK(steepness > 1e-6f) & MASK(towards < 0.0f);
    const floatn scale = 1.0f / (faces ? steepness : 1.0f);
    facing->x = faces ? g.x * scale : facing->x;
    facing->y = faces ? g.y * scale : facing->y;
    facing->z = faces ? g.z * scale : facing->z;
    return faces ? t + step : 0.0f;
}

// Where rays first cross a surface that faces them, as distance in voxels, 0 if nowhere; beside a silhouette a ray may graze
// a solid voxel or cross the field where it slopes away, and goes on to what lies behind. From where a ray enters a solid
// voxel it is two Newton steps to the crossing. -> facing: unit normals.
static floatn find_surface(const Volume volume, const Rays rays, const floatn begin, const floatn end, Vectors *facing) {
    floatn found = 0.0f, t = begin;
    intn looking = MASK(begin < end);
    while (ANY(looking)) {
        t = find_solid_voxels(volume, rays, looking ? t : end, end);
        looking &= MASK(t < end);
        intn falls;
        const Field entered = sample_field(volume, point_at(rays, looking ? t : 1.0f));
        const floatn first = newton_step(rays, entered, volume.truncation_m / volume.voxel_m, &falls);
        falls &= looking;
        if (ANY(falls)) {
            const floatn crossing = cross_near(volume, rays, t + clamp(first, -1.0f, 1.0f), falls, facing);
            found = MASK(crossing > 0.0f) ? crossing : found;
            looking &= MASK(found == 0.0f);
        }
        t += 0.7f;  // the next solid voxel on the way
    }
    return found;
}

// Rays through the pixels x, x + SPACING, ... of row y, LANES of them, and where on them, in voxels, solid voxels may be.
typedef struct {
    Rays rays;
    floatn begin;
    floatn end;
} View;

static inline View view_through(const Volume volume, const float4 intrinsics, const float16 volume_from_camera, const int2 size,
                                const int x, const int y, const float greatest_depth_m, global const int *nearest, global const int *farthest) {
    const float16 m = volume_from_camera;
    const floatn u = (x + SPACING * LANE_NUMBERS - intrinsics.s2) / intrinsics.s0;
    const float v = (y - intrinsics.s3) / intrinsics.s1;
    const floatn length = sqrt(u * u + (v * v + 1.0f));
    const floatn shorten = 1.0f / length;
    const Vectors direction = {(m.s0 * u + (m.s1 * v + m.s2)) * shorten, (m.s4 * u + (m.s5 * v + m.s6)) * shorten,
                               (m.s8 * u + (m.s9 * v + m.sa)) * shorten};
    View view;
    view.rays = make_rays(m.s37b / volume.voxel_m, direction);
    clip_rays(volume, view.rays, &view.begin, &view.end);
    const int row = y / TILE * ((size.x + TILE - 1) / TILE), last = min(x + SPACING * (LANES - 1), size.x - 1) / TILE;
    int near = as_int(INFINITY), far = 0;
    for (int column = x / TILE; column <= last; column++) {
        near = min(near, nearest[row + column]);
        far = max(far, farthest[row + column]);
    }
    const floatn per_depth = length / volume.voxel_m;
    view.begin = fmax(view.begin, as_float(near) * per_depth);
    view.end = fmin(view.end, fmin(greatest_depth_m, as_float(far)) * per_depth);
    return view;
}

// Writes what these pixels see: distances in voxels (0 where nothing), unit normals.
static inline void store_surface(const Volume volume, const Rays rays, const floatn t, const Vectors facing, const int width,
                                 const int x, const int y, global float4 *positions, global float4 *normals) {
    const Vectors point = point_at(rays, t);
    float hits[LANES], px[LANES], py[LANES], pz[LANES], nx[LANES], ny[LANES], nz[LANES];
    STORE_LANES(t, hits);
    STORE_LANES(point.x, px);
    STORE_LANES(point.y, py);
    STORE_LANES(point.z, pz);
    STORE_LANES(facing.x, nx);
    STORE_LANES(facing.y, ny);
    STORE_LANES(facing.z, nz);
    for (int lane = 0; lane < LANES && x + SPACING * lane < width; lane++) {
        const float hit = hits[lane] > 0.0f ? 1.0f : 0.0f;
        positions[y * width + x + SPACING * lane] = (float4)(hit * volume.voxel_m * (float3)(px[lane], py[lane], pz[lane]), hit);
        normals[y * width + x + SPACING * lane] = (float4)(hit * (float3)(nx[lane], ny[lane], nz[lane]), hit);
    }
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
    const View view = view_through(volume, intrinsics, volume_from_camera, (int2)(width, height), x, y, greatest_depth_m, nearest, farthest);
    Vectors facing = {0.0f, 0.0f, 0.0f};
    const floatn t = find_surface(volume, view.rays, view.begin, view.end, &facing);
    store_surface(volume, view.rays, t, facing, width, x, y, positions, normals);
}

// What the rays of pixels around say of rays between them; voxels.
typedef struct {
    floatn nearest, farthest;  // where the rays meet the planes of surface that was seen there
    floatn first;              // distance of the nearest point that was seen there
    intn met;                  // all planes were met
    intn seen;                 // at least one of them has seen surface
    intn inside;               // all are pixels of the picture
} Around;

// Adds the pixels x, x + SPACING, ... of row y.
static inline void look_beside(const Rays rays, const float voxel_m, const int2 size, const int x, const int y,
                               global const float4 *positions, global const float4 *normals, Around *around) {
    float height[LANES], nx[LANES], ny[LANES], nz[LANES], away[LANES];
    int seen[LANES], inside[LANES];
    for (int lane = 0; lane < LANES; lane++) {
        const int at = x + SPACING * lane;
        inside[lane] = -(at >= 0 && at < size.x && y >= 0 && y < size.y);
        const int pixel = inside[lane] ? y * size.x + at : 0;
        const float4 normal = inside[lane] ? normals[pixel] : (float4)(0.0f);
        const float3 offset = positions[pixel].xyz / voxel_m - rays.origin;
        height[lane] = dot(offset, normal.xyz);
        away[lane] = dot(offset, offset);
        nx[lane] = normal.x, ny[lane] = normal.y, nz[lane] = normal.z;
        seen[lane] = -(normal.w > 0.0f);
    }
    const intn is_seen = LOAD_LANES(seen);
    const floatn towards = LOAD_LANES(nx) * rays.direction.x + LOAD_LANES(ny) * rays.direction.y + LOAD_LANES(nz) * rays.direction.z;
    const intn meets = is_seen & MASK(towards < -LEAST_SLOPE);
    const floatn t = LOAD_LANES(height) / (meets ? towards : -1.0f);
    around->nearest = meets ? fmin(around->nearest, t) : around->nearest;
    around->farthest = meets ? fmax(around->farthest, t) : around->farthest;
    around->first = is_seen ? fmin(around->first, sqrt(LOAD_LANES(away))) : around->first;
    around->met &= meets;
    around->seen |= is_seen;
    around->inside &= LOAD_LANES(inside);
}

// The pixels that `raycast` has left out, with SPACING 2: the third index says which of a square of four. As long as a ray is within a
// voxel of those beside it, the volume holds nothing that they would miss. So where they have seen nothing, it sees nothing; where it
// meets the planes that they have seen at one place, a Newton step from there finds the crossing; elsewhere it is walked from shortly before
// what they have seen.
kernel void raycast_between(VIEW_PARAMETERS, global float4 *positions, global float4 *normals) {
    const int dx = get_global_id(2) != 1, dy = get_global_id(2) != 0;
    const int x = SPACING * get_global_id(0) * LANES + dx;
    const int y = SPACING * get_global_id(1) + dy;
    if (x >= width || y >= height || get_global_id(2) > 2) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const int2 size = (int2)(width, height);
    const View view = view_through(volume, intrinsics, volume_from_camera, size, x, y, greatest_depth_m, nearest, farthest);
    const intn all = MASK(view.begin < view.end), none = MASK(view.begin != view.begin);
    Around around = {1e9f, 0.0f, 1e9f, all, none, all};
    for (int i = -dy; i <= dy; i += 2)
        for (int j = -dx; j <= dx; j += 2)
            look_beside(view.rays, volume.voxel_m, size, x + j, y + i, positions, normals, &around);
    const float focal = fmin(intrinsics.s0, intrinsics.s1);
    const floatn middle = 0.5f * (around.nearest + around.farthest);
    const intn smooth = around.met & MASK(around.farthest - around.nearest < SMOOTH) & MASK(around.farthest < focal);
    const intn empty = around.inside & ~around.seen & MASK(view.end < focal);
    Vectors facing = {0.0f, 0.0f, 0.0f};
    floatn t = 0.0f;
    if (ANY(smooth)) t = cross_near(volume, view.rays, middle, smooth, &facing);
    t = MASK(fabs(t - middle) < CLOSE) ? t : 0.0f;
    const intn walked = all & ~empty & MASK(t == 0.0f);
    if (ANY(walked)) {
        const intn bounded = around.inside & MASK(around.first < focal);
        const floatn begin = bounded ? fmax(view.begin, around.first - BEFORE) : view.begin;
        const floatn found = find_surface(volume, view.rays, walked ? begin : view.end, view.end, &facing);
        t = walked ? found : t;
    }
    store_surface(volume, view.rays, t, facing, width, x, y, positions, normals);
}
