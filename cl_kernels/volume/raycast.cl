// Surface prediction (KinectFusion; thesis 4.2.1): the zero crossing of the TSDF along each pixel's ray, and its normal.
// Provides bound_rays, raycast.
#include "camera.clh"
#include "field.clh"
#include "rays.clh"

#define TILE 8

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

// Where rays first cross a surface that faces them, as distance in voxels, 0 if nowhere; beside a silhouette a ray may graze
// a solid voxel or cross the field where it slopes away, and goes on to what lies behind. From where a ray enters a solid
// voxel it is two Newton steps to the crossing. -> facing: unit normals.
static floatn find_surface(const Volume volume, const Rays rays, const floatn begin, const floatn end, Vectors *facing) {
    const float truncation_voxels = volume.truncation_m / volume.voxel_m;
    floatn found = 0.0f, t = begin;
    intn looking = MASK(begin < end);
    while (ANY(looking)) {
        t = find_solid_voxels(volume, rays, looking ? t : end, end);
        looking &= MASK(t < end);
        intn falls, still;
        const floatn first = newton_step(rays, sample_field(volume, point_at(rays, looking ? t : 1.0f)), truncation_voxels, &falls);
        falls &= looking;
        if (ANY(falls)) {
            const floatn near = falls ? t + clamp(first, -1.0f, 1.0f) : t;
            Vectors g;
            const Field there = sample_surface(volume, point_at(rays, falls ? near : 1.0f), &g);
            const floatn second = newton_step(rays, there, truncation_voxels, &still);
            const floatn steepness = sqrt(g.x * g.x + g.y * g.y + g.z * g.z);
            const floatn towards = g.x * rays.direction.x + g.y * rays.direction.y + g.z * rays.direction.z;
            const intn faces = falls & still & MASK(fabs(second) < 1.0f) & MASK(near + second > 0.0f) & MASK(steepness > 1e-6f) &
                               MASK(towards < 0.0f);
            const floatn scale = 1.0f / (faces ? steepness : 1.0f);
            facing->x = faces ? g.x * scale : facing->x;
            facing->y = faces ? g.y * scale : facing->y;
            facing->z = faces ? g.z * scale : facing->z;
            found = faces ? near + second : found;
            looking &= ~faces;
        }
        t += 0.7f;  // the next solid voxel on the way
    }
    return found;
}

// Volume and view -> positions [h][w] (volume space metres, w = 1 surface, 0 none), normals [h][w] (unit, towards free
// space, w likewise). One item LANES pixels of a row.
kernel void raycast(const int width, const int height, VOLUME_PARAMETERS, const float4 intrinsics, const float16 volume_from_camera,
                    const float greatest_depth_m, global const int *nearest, global const int *farthest,
                    global float4 *positions, global float4 *normals) {
    const int x = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Volume volume = VOLUME_OF_PARAMETERS;
    const float16 m = volume_from_camera;
    const floatn u = (x + LANE_NUMBERS - intrinsics.s2) / intrinsics.s0;
    const float v = (y - intrinsics.s3) / intrinsics.s1;
    const floatn length = sqrt(u * u + (v * v + 1.0f));
    const floatn shorten = 1.0f / length;
    const Vectors direction = {(m.s0 * u + (m.s1 * v + m.s2)) * shorten, (m.s4 * u + (m.s5 * v + m.s6)) * shorten,
                               (m.s8 * u + (m.s9 * v + m.sa)) * shorten};
    const Rays rays = make_rays(m.s37b / shape.voxel_m, direction);
    floatn begin, end;
    clip_rays(volume, rays, &begin, &end);
    const int tile = y / TILE * ((width + TILE - 1) / TILE) + x / TILE;
    const floatn per_depth = length / shape.voxel_m;
    begin = fmax(begin, as_float(nearest[tile]) * per_depth);
    end = fmin(end, fmin(greatest_depth_m, as_float(farthest[tile])) * per_depth);

    Vectors facing = {0.0f, 0.0f, 0.0f};
    const floatn t = find_surface(volume, rays, begin, end, &facing);
    const Vectors point = point_at(rays, t);
    float hits[LANES], px[LANES], py[LANES], pz[LANES], nx[LANES], ny[LANES], nz[LANES];
    STORE_LANES(t, hits);
    STORE_LANES(point.x, px);
    STORE_LANES(point.y, py);
    STORE_LANES(point.z, pz);
    STORE_LANES(facing.x, nx);
    STORE_LANES(facing.y, ny);
    STORE_LANES(facing.z, nz);
    const int lanes = min(LANES, width - x);
    for (int lane = 0; lane < lanes; lane++) {
        const float hit = hits[lane] > 0.0f ? 1.0f : 0.0f;
        positions[y * width + x + lane] = (float4)(hit * shape.voxel_m * (float3)(px[lane], py[lane], pz[lane]), hit);
        normals[y * width + x + lane] = (float4)(nx[lane], ny[lane], nz[lane], hit);
    }
}
