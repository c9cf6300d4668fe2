// Differential rendering (thesis 7.1): how virtual objects change the light that reaches real and virtual surfaces.
// Provides shadow_real, bounce_real, shadow_virtual, light_points.
//
// Equation 7.1 adds the difference of two shadings R and R' to the picture scaled by the picture itself. For a Lambertian
// surface the picture is albedo times R, so the factor that leaves the albedo alone is R' / R; it needs no tone mapper.
// With light from surfaces (7.3.3), R and R' include one bounce: visible surface sends the radiance that the camera saw.
#include "direct_mix.clh"
#include "direction_sets.clh"
#include "kept_shadows.clh"
#include "met.clh"
#include "open_shading.clh"
#include "real_shading.clh"
#include "samples.clh"
#include "shadows.clh"
#include "sharers.clh"
#include "ways.clh"

// What the discs of the light bring to the samples [rows][cols], without and with objects (light_samples of shadow_map.cl), and
// the least shading that counts, see direct_mix.clh. has_discs: 0: the light has none.
#define DISC_SAMPLES const int has_discs, const float4 least, global const float4 *without_discs, global const float4 *with_discs

// A block of `step` x `step` samples from (row, col) on, where there is surface; 0 elsewhere. whole, whole_shaded: under all light.
static void write_block(const Grid grid, global const float4 *positions, global const float4 *normals, const int row, const int col,
                        const int step, const float4 of_ratio, const float4 of_shaded, global float4 *ratio, global float4 *shaded,
                        DISC_SAMPLES, global float4 *whole, global float4 *whole_shaded) {
    for (int i = row; i < min(row + step, grid.rows); i++) {
        for (int j = col; j < min(col + step, grid.cols); j++) {
            const int there = sample_pixel(grid, i, j), sample = i * grid.cols + j;
            const int known = positions[there].w > 0.0f && normals[there].w > 0.0f;
            const float4 its_ratio = known ? of_ratio : (float4)(0.0f), its_shaded = known ? of_shaded : (float4)(0.0f);
            ratio[sample] = its_ratio;
            shaded[sample] = its_shaded;
            if (!has_discs) continue;
            const float3 without = without_discs[sample].xyz, with = with_discs[sample].xyz;
            whole[sample] = (float4)(mixed_ratio(its_ratio.xyz, its_shaded.xyz, without, with, least.xyz), its_ratio.w);
            whole_shaded[sample] = (float4)(fmax(its_shaded.xyz, least.xyz) + without, its_shaded.w);
        }
    }
}

// Real surface: the ratio R' / R of shading with virtual objects to shading without, at the samples of the transfer.
// transfer [rows][cols][COEFFICIENTS]; hits [rows][cols]: see indirect.cl.
// -> ratio [rows][cols] (rgb, w = 1), shaded [rows][cols] (rgb of R, w = 1); w = 0 where there is no surface. R is computed even
// where objects take nothing: other parts of the light (shadow_map.cl), bounces and refined pixels (adaptive.cl) relate to it.
// SHARERS items a block of `step` x `step` samples, which get the ratio of the first of them, or none where that has no surface.
// whole, whole_shaded [rows][cols]: ratio and R with what the discs bring, written if has_discs.
// Samples whose cell keeps a ratio get that one. Of the others, if `asking`, each asks to fill its cell -> asked [rows][cols], found
// [rows][cols]: the cell's value then; changes: see count_change. ways [rows][cols], if has_ways: how samples came to
// their transfer (ways.clh); where it was traced in this frame, what was kept is not used.
kernel void shadow_real(REAL_SCENE_PARAMETERS, SAMPLE_BUFFERS, const int step, global const float *transfer, global const float4 *hits,
                        DISC_SAMPLES, SHADOW_CELLS, const int asking, const int has_ways, global const uchar *ways, global int4 *asked,
                        global float4 *found, global int *changes, global float4 *ratio, global float4 *shaded, global float4 *whole,
                        global float4 *whole_shaded) {
    SHARED_PARTS
    const int sharer = SHARER;
    const int col = step * (get_global_id(0) / SHARERS);
    const int row = step * get_global_id(1);
    const Grid grid = scene.samples;
    const int is_inside = col < grid.cols && row < grid.rows, sample = is_inside ? row * grid.cols + col : 0;
    const int pixel = is_inside ? sample_pixel(grid, row, col) : 0;
    const float4 normal = normals[pixel], position = positions[pixel];
    const int is_known = is_inside && position.w > 0.0f && normal.w > 0.0f;
    const int place = place_near(scene.light.table, light_table, position.xyz);
    const Arriving arrives = ARRIVING_UNCHANGED(place);
    const int way = has_ways ? ways[sample] : AS_KEPT;
    ShadowCell cell = find_shadow(cells, table, position, normal.xyz, -1);
    cell.is_kept &= way != ANEW;
    float4 own_part = (float4)(0.0f);
    if (is_known && !cell.is_kept) {
        const Volume volume = SOLIDS_OF_SCENE;
        const Objects things = OBJECTS_OF_SCENE(0.0f);
        global const uint *free = free_mask + sample * MASK_WORDS;
        global const uchar *own = sets + sample * INTERLEAVE;
        own_part.xyz = taken_from_real(volume, things, arrives, scene.objects.ball, position.xyz, normal.xyz, 0, sharer, SHARERS, own,
                                       INTERLEAVE, free);
    }
    const float3 taken = SUM_OF_SHARERS(own_part).xyz / SHARERS;
    if (!(is_inside & (sharer == 0))) return;
    float4 of_ratio = (float4)(0.0f), of_shaded = (float4)(0.0f);
    uint number = 0;
    if (is_known) {
        global const float4 *light = coefficients_of(scene.light.table, light_table, place);
        float3 without = (float3)(0.0f);
        for (int i = 0; i < COEFFICIENTS; i++) without += transfer[sample * COEFFICIENTS + i] * light[i].xyz;
        without = shading_without(arrives, without, openness[sample], hits[sample]);
        const float3 floor = LEAST_SHADING * 0.28209479f * light[0].xyz + 1e-9f;
        const float3 own = fmax(without - taken, floor) / fmax(without, floor);
        const int is_lent = way == OF_ANOTHER;
        of_ratio = (float4)(cell.is_kept ? cell.value.xyz : with_found(cells, cell, own, sample, is_lent, &number), 1.0f);
        if (asking) found[sample] = of_ratio;
        if (asking) count_change(cell, cell.value.xyz, own, (float3)(1.0f), is_lent, changes);
        of_shaded = (float4)(without, 1.0f);
    }
    if (!is_known) cell.place = -1;
    if (asking) ask_to_keep(cell, number, sample, table, asked);
    write_block(grid, positions, normals, row, col, step, of_ratio, of_shaded, ratio, shaded, has_discs, least, without_discs, with_discs,
                whole, whole_shaded);
}

// The ratio under the light without its discs from the ratio under the whole light: the inverse of mixed_ratio. rest: R of the former.
static inline float4 without_discs_of(const float4 whole, const float3 rest, const float3 without, const float3 with, const float3 least) {
    const float3 before = fmax(rest, least);
    return (float4)((whole.xyz * (before + without) - with) / before, whole.w);
}

// The ratio `before` of a sample of real surface with the light that it gains from other real surface whose shading virtual objects
// changed (eq. 7.6: R'_ID - R_ID). Arguments as in bounce_real.
static float4 bounced_ratio(const Volume volume, const Arriving arrives, const float4 position, const float3 normal, const float4 before,
                            const float openness, const float3 shaded, const float3 rest, const float3 floor, global const uchar *own,
                            const int most, global const uint *met, const float returned, const float spare) {
    const float3 counts = fmax(rest, floor);
    const float part_hidden = clamp(1.0f - openness, 0.0f, 1.0f);
    if (part_hidden == 0.0f || part_hidden * returned <= spare * fmin(fmin(counts.x, counts.y), counts.z)) return before;
    const float3 origin = position.xyz + volume.voxel_m * normal;
    float4 sum = (float4)(0.0f);
    for (int i = 0; i < most && met[i] != NO_MORE_MET; i++) {
        const int j = direction_of_met(met[i]);
        const float3 direction = arrives.directions[own[j % INTERLEAVE] * arrives.count + j].xyz;
        const float3 at_m = origin + distance_of_met(met[i]) * direction;
        const float3 change = nearest_change(arrives.changed, at_m, SAME_POINT * volume.voxel_m) - 1.0f;
        const float3 more = any(change != 0.0f) ? change * sent_at(volume, arrives, at_m / volume.voxel_m, 0) : (float3)(0.0f);
        sum += fmax(dot(normal, direction), 0.0f) * (float4)(more, 1.0f);  // a cell's normal may differ from the sample's
    }
    const float3 gained = part_hidden * sum.xyz / fmax(sum.w, 1e-6f);
    const float3 without = fmax(shaded, floor);
    return (float4)(fmax(before.xyz * without + gained, floor) / without, 1.0f);
}

// Real surface: the ratio under all light with one bounce between real surfaces. met [rows][cols][most]: some of a sample's blocked
// directions, and where they meet surface (indirect.cl). changed: the ratio of shadow_real under all light; shaded, rest [rows][cols]:
// R under all light and under that without discs, the same where it has none. returned: bound on the change of radiance from a
// blocked direction; a sample that it can change by at most `spare` times `rest` gains nothing.
// -> bounced [rows][cols] (rgb, w = 1), w = 0 as in `changed`; bounced_rest: the ratio without the discs, written if has_discs.
kernel void bounce_real(SURROUNDINGS_PARAMETERS, SAMPLE_BUFFERS, const int most, global const uint *met, global const float4 *shaded,
                        global const float4 *rest, const float returned, const float spare, DISC_SAMPLES, global float4 *bounced,
                        global float4 *bounced_rest) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    const Grid grid = scene.samples;
    if (col >= grid.cols || row >= grid.rows) return;
    const int sample = row * grid.cols + col;
    const int pixel = sample_pixel(grid, row, col);
    float4 ratio = changed_ratio[sample];
    if (ratio.w > 0.0f) {
        const int place = place_near(scene.light.table, light_table, positions[pixel].xyz);
        const float3 floor = LEAST_SHADING * 0.28209479f * coefficients_of(scene.light.table, light_table, place)[0].xyz + 1e-9f;
        const Volume volume = SOLIDS_OF_SCENE;
        const Arriving arrives = ARRIVING_OF_SCENE(place);
        ratio = bounced_ratio(volume, arrives, positions[pixel], normals[pixel].xyz, ratio, openness[sample], shaded[sample].xyz,
                              rest[sample].xyz, floor, sets + sample * INTERLEAVE, most, met + sample * most, returned, spare);
    }
    bounced[sample] = ratio;
    if (has_discs)
        bounced_rest[sample] = without_discs_of(ratio, rest[sample].xyz, without_discs[sample].xyz, with_discs[sample].xyz, least.xyz);
}

// Virtual surface: the radiance that real and virtual occluders take from it, at the samples that it covers.
// positions, normals [h][w] (w = 1 where covered), shown [h][w] (which object, -1 none): the virtual geometry buffer.
// scene.every: a sample traces every n-th direction of its set; its neighbours trace others. -> occluded [rows][cols] (rgb, w = 1 valid)
// at the samples `around` (x0 y0 x1 y1, half-open).
// Samples whose cell keeps what is taken, over cells.level, get that; the others ask to fill it, in each frame with the next part of
// their directions. -> found, asked, changes: as in shadow_real.
kernel void shadow_virtual(SCENE_PARAMETERS, const int4 around, global const float4 *positions, global const float4 *normals, global const int *shown,
                           SHADOW_CELLS, global int4 *asked, global float4 *found, global int *changes, global float4 *occluded) {
    SHARED_PARTS
    const int sharer = SHARER;
    const int col = around.x + get_global_id(0) / SHARERS;
    const int row = around.y + get_global_id(1);
    const Grid grid = scene.samples;
    const int is_inside = col < around.z && row < around.w;
    const int sample = is_inside ? row * grid.cols + col : 0, every = scene.every, pixel = is_inside ? sample_pixel(grid, row, col) : 0;
    const float4 position = positions[pixel], normal = normals[pixel];
    const int place = place_of_object(scene.light.table, light_table, shown[pixel]);
    const ShadowCell cell = find_shadow(cells, table, position, normal.xyz, shown[pixel]);
    float4 own = (float4)(0.0f);
    if (is_inside && !cell.is_kept) {
        const Volume volume = VOLUME_OF_SCENE;
        const Objects things = OBJECTS_OF_SCENE(own_offset_m(scene.objects.count, grids_of(object_table), shown[pixel]));
        const Arriving arrives = ARRIVING_OF_SCENE(place);
        own = taken_from_virtual(volume, things, arrives, position, normal.xyz, direction_set(row, col),
                                 direction_subset(row, col + max(cells.now - 1, 0), every) + every * sharer, every * SHARERS);
    }
    const float4 taken = SUM_OF_SHARERS(own) / SHARERS;
    if (!(is_inside & (sharer == 0))) return;
    occluded[sample] = taken;
    if (cells.places == 0) return;
    uint number = 0;
    const float3 value = cell.is_kept ? cell.value.xyz : with_found(cells, cell, taken.xyz / cells.level, sample, 0, &number);
    if (position.w > 0.0f) {
        const float3 open = open_shading(normal.xyz, coefficients_of(scene.light.table, light_table, place));
        count_change(cell, open - cells.level * cell.value.xyz, open - taken.xyz, open, 0, changes);
    }
    if (cell.is_true) occluded[sample] = (float4)(cells.level * value, 1.0f);
    found[sample] = (float4)(value, 0.0f);
    ask_to_keep(cell, number, sample, table, asked);
}

// Radiance of points on virtual objects. points, normals (volume space), albedos [points_count] -> radiances [points_count] (rgb).
// offsets_m [points_count]: distance from the surface at which rays begin. SHARERS items a point.
kernel void light_points(SCENE_PARAMETERS, const int points_count, global const float4 *points, global const float4 *normals,
                         global const float4 *albedos, global const float *offsets_m, global float4 *radiances) {
    SHARED_PARTS
    const int sharer = SHARER;
    const int index = get_global_id(0) / SHARERS, is_inside = index < points_count, at = is_inside ? index : 0;
    const int place = place_near(scene.light.table, light_table, points[at].xyz);
    const float3 normal = normals[at].xyz;
    float4 own = (float4)(0.0f);
    if (is_inside) {
        const Volume volume = VOLUME_OF_SCENE;
        const Objects things = OBJECTS_OF_SCENE(offsets_m[at]);
        const Arriving arrives = ARRIVING_OF_SCENE(place);
        own = taken_from_virtual(volume, things, arrives, points[at], normal, direction_set(at >> 3, at & 7), sharer, SHARERS);
    }
    const float3 taken = SUM_OF_SHARERS(own).xyz / SHARERS;
    if (!(is_inside & (sharer == 0))) return;
    const float3 open = open_shading(normal, coefficients_of(scene.light.table, light_table, place));
    radiances[at] = (float4)(albedos[at].xyz * fmax(open - taken, 0.0f), 1.0f);
}
