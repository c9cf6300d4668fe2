// Differential rendering (thesis 7.1): how virtual objects change the light that reaches real and virtual surfaces.
// Provides shadow_real, bounce_real, shadow_virtual, light_points.
//
// Equation 7.1 adds the difference of two shadings R and R' to the picture scaled by the picture itself. For a Lambertian
// surface the picture is albedo times R, so the factor that leaves the albedo alone is R' / R; it needs no tone mapper.
// With light from surfaces (7.3.3), R and R' include one bounce: visible surface sends the radiance that the camera saw.
#include "direction_sets.clh"
#include "met.clh"
#include "open_shading.clh"
#include "real_shading.clh"
#include "samples.clh"
#include "shadows.clh"

// A block of `step` x `step` samples from (row, col) on, where there is surface; 0 elsewhere.
static void write_block(const Grid grid, global const float4 *positions, global const float4 *normals, const int row, const int col,
                        const int step, const float4 of_ratio, const float4 of_shaded, global float4 *ratio, global float4 *shaded) {
    for (int i = row; i < min(row + step, grid.rows); i++) {
        for (int j = col; j < min(col + step, grid.cols); j++) {
            const int there = sample_pixel(grid, i, j);
            const int known = positions[there].w > 0.0f && normals[there].w > 0.0f;
            ratio[i * grid.cols + j] = known ? of_ratio : (float4)(0.0f);
            shaded[i * grid.cols + j] = known ? of_shaded : (float4)(0.0f);
        }
    }
}

// Real surface: the ratio R' / R of shading with virtual objects to shading without, at the samples of the transfer.
// transfer [rows][cols][COEFFICIENTS]; hits [rows][cols]: see indirect.cl.
// -> ratio [rows][cols] (rgb, w = 1), shaded [rows][cols] (rgb of R, w = 1); w = 0 where there is no surface. R is computed even
// where objects take nothing: other parts of the light (shadow_map.cl), bounces and refined pixels (adaptive.cl) relate to it.
// One item a block of `step` x `step` samples, which get the ratio of the first of them, or none where that has no surface.
kernel void shadow_real(REAL_SCENE_PARAMETERS, SAMPLE_BUFFERS, const int step, global const float *transfer, global const float4 *hits,
                        global float4 *ratio, global float4 *shaded) {
    const int col = step * get_global_id(0);
    const int row = step * get_global_id(1);
    const Grid grid = scene.samples;
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col;
    const int pixel = sample_pixel(grid, row, col);
    const float4 normal = normals[pixel], position = positions[pixel];
    if (position.w <= 0.0f || normal.w <= 0.0f) {
        write_block(grid, positions, normals, row, col, step, (float4)(0.0f), (float4)(0.0f), ratio, shaded);
        return;
    }
    const Volume volume = SOLIDS_OF_SCENE;
    const Objects things = OBJECTS_OF_SCENE(0.0f);
    const int place = place_near(scene.light.table, light_table, position.xyz);
    const Arriving arrives = ARRIVING_UNCHANGED(place);
    global const float4 *light = coefficients_of(scene.light.table, light_table, place);
    global const uint *free = free_mask + sample * MASK_WORDS;
    global const uchar *own = sets + sample * INTERLEAVE;
    float3 without = (float3)(0.0f);
    for (int i = 0; i < COEFFICIENTS; i++) without += transfer[sample * COEFFICIENTS + i] * light[i].xyz;
    without = shading_without(arrives, without, openness[sample], hits[sample]);
    const float3 taken = taken_from_real(volume, things, arrives, scene.objects.ball, position.xyz, normal.xyz, 0, 0, 1, own, INTERLEAVE, free);
    const float3 floor = LEAST_SHADING * 0.28209479f * light[0].xyz + 1e-9f;
    const float4 of_ratio = (float4)(fmax(without - taken, floor) / fmax(without, floor), 1.0f);
    const float4 of_shaded = (float4)(without, 1.0f);
    write_block(grid, positions, normals, row, col, step, of_ratio, of_shaded, ratio, shaded);
}

// Light that a sample of real surface gains from other real surface whose shading virtual objects changed (eq. 7.6: R'_ID - R_ID),
// added to the ratio. met [rows][cols][most]: some of its blocked directions, and where they meet surface (indirect.cl).
// ratio, shaded [rows][cols]: of shadow_real; changed: that ratio. returned: bound on the change of radiance from a blocked
// direction; a sample that it can change by at most `spare` times `least` [rows][cols] (at most `shaded`) gains nothing.
// -> bounced [rows][cols] (rgb, w = 1), w = 0 as in ratio.
kernel void bounce_real(SURROUNDINGS_PARAMETERS, SAMPLE_BUFFERS, const int most, global const uint *met, global const float4 *shaded,
                        const float returned, const float spare, global const float4 *least, global float4 *bounced) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    const Grid grid = scene.samples;
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col;
    const int pixel = sample_pixel(grid, row, col);
    const float4 normal = normals[pixel], before = changed_ratio[sample];
    if (before.w <= 0.0f) {
        bounced[sample] = before;
        return;
    }
    const int place = place_near(scene.light.table, light_table, positions[pixel].xyz);
    const float3 floor = LEAST_SHADING * 0.28209479f * coefficients_of(scene.light.table, light_table, place)[0].xyz + 1e-9f;
    const float3 counts = fmax(least[sample].xyz, floor);
    const float part_hidden = clamp(1.0f - openness[sample], 0.0f, 1.0f);
    if (part_hidden == 0.0f || part_hidden * returned <= spare * fmin(fmin(counts.x, counts.y), counts.z)) {
        bounced[sample] = before;
        return;
    }
    const Volume volume = SOLIDS_OF_SCENE;
    const Arriving arrives = ARRIVING_OF_SCENE(place);
    const float3 origin = positions[pixel].xyz + volume.voxel_m * normal.xyz;
    float4 sum = (float4)(0.0f);
    for (int i = 0; i < most && met[sample * most + i] != NO_MORE_MET; i++) {
        const uint there = met[sample * most + i];
        const int j = direction_of_met(there);
        const float3 direction = arrives.directions[sets[sample * INTERLEAVE + j % INTERLEAVE] * arrives.count + j].xyz;
        const float3 at_m = origin + distance_of_met(there) * direction;
        const float3 change = change_at(arrives.changed, at_m, SAME_POINT * volume.voxel_m) - 1.0f;
        const float3 more = any(change != 0.0f) ? change * sent_at(volume, arrives, at_m / volume.voxel_m, 0) : (float3)(0.0f);
        sum += fmax(dot(normal.xyz, direction), 0.0f) * (float4)(more, 1.0f);  // a cell's normal may differ from the sample's
    }
    const float3 gained = part_hidden * sum.xyz / fmax(sum.w, 1e-6f);
    const float3 without = fmax(shaded[sample].xyz, floor);
    bounced[sample] = (float4)(fmax(before.xyz * without + gained, floor) / without, 1.0f);
}

// Virtual surface: the radiance that real and virtual occluders take from it, at the samples that it covers.
// positions, normals [h][w] (w = 1 where covered), shown [h][w] (which object, -1 none): the virtual geometry buffer.
// scene.every: a sample traces every n-th direction of its set; its neighbours trace others. -> occluded [rows][cols] (rgb, w = 1 valid)
// at the samples `around` (x0 y0 x1 y1, half-open).
kernel void shadow_virtual(SCENE_PARAMETERS, const int4 around, global const float4 *positions, global const float4 *normals, global const int *shown,
                           global float4 *occluded) {
    const int col = around.x + get_global_id(0);
    const int row = around.y + get_global_id(1);
    const Grid grid = scene.samples;
    if (col >= around.z || row >= around.w) return;
    const int pixel = sample_pixel(grid, row, col);
    const Volume volume = VOLUME_OF_SCENE;
    const Objects things = OBJECTS_OF_SCENE(own_offset_m(scene.objects.count, grids_of(object_table), shown[pixel]));
    const Arriving arrives = ARRIVING_OF_SCENE(place_of_object(scene.light.table, light_table, shown[pixel]));
    occluded[row * grid.cols + col] = taken_from_virtual(volume, things, arrives, positions[pixel], normals[pixel].xyz, direction_set(row, col),
                                                    direction_subset(row, col, scene.every), scene.every);
}

// Radiance of points on virtual objects. points, normals (volume space), albedos [points_count] -> radiances [points_count] (rgb).
// offsets_m [points_count]: distance from the surface at which rays begin.
kernel void light_points(SCENE_PARAMETERS, const int points_count, global const float4 *points, global const float4 *normals,
                         global const float4 *albedos, global const float *offsets_m, global float4 *radiances) {
    const int index = get_global_id(0);
    if (index >= points_count) return;
    const Volume volume = VOLUME_OF_SCENE;
    const Objects things = OBJECTS_OF_SCENE(offsets_m[index]);
    const int place = place_near(scene.light.table, light_table, points[index].xyz);
    const Arriving arrives = ARRIVING_OF_SCENE(place);
    const float3 normal = normals[index].xyz;
    const float4 taken = taken_from_virtual(volume, things, arrives, points[index], normal, direction_set(index >> 3, index & 7), 0, 1);
    radiances[index] = (float4)(albedos[index].xyz * fmax(open_shading(normal, coefficients_of(scene.light.table, light_table, place)) - taken.xyz,
    0.0f), 1.0f);
}
