// Radiance transfer that earlier frames found at places of the world, in a hash table of cells.
// Provides find_samples, choose_samples, store_samples.
//
// A cell is about as large as the distance between samples there, so that a sample of the next frame finds what one of this frame left.
// Two places of the table are tried for a cell. Which sample fills a place, and which are traced, depends on the numbers of the samples
// only, not on the order in which work-items run.
#ifdef IS_TRACED  // by rays, which can be traced again
#include "hemisphere.clh"
#include "meeting.clh"
#include "met.clh"
#endif
#include "samples.clh"
#include "ways.clh"
#include "world_cells.clh"

#ifndef BANDS
#error BANDS must be defined: the number of spherical-harmonics bands
#endif
#ifndef MASK_WORDS
#error MASK_WORDS must be defined: 32-bit words that hold one bit a direction
#endif
#ifndef MOST_MET
#error MOST_MET must be defined: directions of a sample whose surface is known
#endif
#define COEFFICIENTS (BANDS * BANDS)

#define FACING 0.8f  // least cosine between normals of one surface
#define NOT_STORED (-1)
#define LENT (1 << 30)  // with the number of the sample whose values a sample takes; a table has fewer places
#define ORDERS 16       // of samples in a block of 4 x 4, for those that are new and for those that are old
#define BLOCK 4

// Words of an entry. The first is 0 where there is none.
#define KEY 0
#define TRACED 2  // frame in which it was traced
#define USED 3    // frame in which it was last found
#define SET 4
#define POSITION 5
#define NORMAL 8
#define OPENNESS 11
#define FLATNESS 12
#define HITS 13
#define RISE 17  // the mean normal that its rays rise from; three words
#define MASK_AT 20
#define TRANSFER (MASK_AT + MASK_WORDS)
#define MET (TRANSFER + COEFFICIENTS)
#define WORDS (MET + MOST_MET)

static inline int holds(global const uint *entry, const uint2 key) {
    return entry[KEY] == key.x && entry[KEY + 1] == key.y;
}

static inline float3 vector_in(global const uint *entry, const int at) {
    return (float3)(as_float(entry[at]), as_float(entry[at + 1]), as_float(entry[at + 2]));
}

// Whether an entry is of this cell, and of the surface at this point.
static inline int is_of(global const uint *entry, const Cell cell, const float3 position, const float3 normal) {
    return holds(entry, cell.key) && fabs(dot(vector_in(entry, POSITION) - position, normal)) <= cell.side_m &&
           dot(vector_in(entry, NORMAL), normal) >= FACING;
}

// Where a new sample stands in the order in which those of its block are traced: each is far from those before it.
static inline int order_of_new(const int row, const int col) {
    const uchar order[BLOCK * BLOCK] = {0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5};
    return order[row % BLOCK * BLOCK + col % BLOCK];
}

// Where an old entry stands: at another place in each frame, so that none waits for more than ORDERS of them.
static inline int order_of_old(const int place, const int now) {
    return (place + now) % ORDERS;
}

// Whether an entry is checked in this frame, if it is found.
static inline int is_to_check(const TransferCacheParameters p, const int place) {
    return p.checks > 0 && (place + p.now) % p.checks == 0;
}

// positions, normals [h][w]: the geometry buffer; entries [places][WORDS]. -> found [rows][cols]: the place of a sample's entry,
// whose values are then in transfer, openness, flatness, free_mask, sets (see radiance_transfer.cl) hits and met (see indirect.cl); the
// same as -2 - place where it is too old; or NOT_STORED, where they are as they were. counts [2 * ORDERS + 1], 0 before: surface samples
// that have no entry, by order, then entries that are too old. claims [places], all UINT_MAX before: the first sample of each of these, and
// of those that are checked.
kernel void find_samples(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals,
                         global uint *entries, global float *transfer, global float *openness, global float *flatness,
                         global uint *free_mask, global uchar *sets, global float4 *hits, global uint *met, global int *found,
                         global int *counts, global uint *claims) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    found[sample] = NOT_STORED;
    if (position.w <= 0.0f || normal.w <= 0.0f) return;
    const Cell cell = cell_of(p.eye.xyz, p.spacing, p.places, position.xyz, normal.xyz);
    for (int way = 0; way < WAYS; way++) {
        const int place = cell.places[way];
        global uint *entry = entries + (size_t)place * WORDS;
        if (!is_of(entry, cell, position.xyz, normal.xyz)) continue;
        const int is_met = atomic_xchg(&entry[USED], (uint)p.now) == (uint)p.now;
        for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = as_float(entry[TRANSFER + i]);
        for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = entry[MASK_AT + i];
        for (int i = 0; i < MOST_MET; i++) met[sample * MOST_MET + i] = entry[MET + i];
        openness[sample] = as_float(entry[OPENNESS]);
        flatness[sample] = as_float(entry[FLATNESS]);
        sets[sample] = (uchar)entry[SET];
        hits[sample] = (float4)(vector_in(entry, HITS), as_float(entry[HITS + 3]));
        const int is_old = p.renews || p.now - (int)entry[TRACED] >= p.period;
        found[sample] = is_old ? -2 - place : place;
        if (is_old || is_to_check(p, place)) atomic_min(&claims[place], (uint)sample);
        if (is_old && !is_met) atomic_inc(&counts[ORDERS + order_of_old(place, p.now)]);
        return;
    }
    atomic_inc(&counts[order_of_new(row, col)]);
}

// How many orders are traced: all whose samples are `left` at most, but always the first that has any.
static inline int orders_in(global const int *counts, const int left) {
    int orders = 0, sum = 0;
    while (orders < ORDERS && (sum == 0 || sum + counts[orders] <= left)) sum += counts[orders++];
    return orders;
}

static inline int sum_of(global const int *counts, const int orders) {
    int sum = 0;
    for (int i = 0; i < orders; i++) sum += counts[i];
    return sum;
}

// The nearest sample on the same surface, of those up to BLOCK - 1 samples away, that has values: it is found, or new and of the first
// `orders`. NOT_STORED where there is none.
static int lender_of(const Grid grid, global const float4 *positions, global const float4 *normals, global const int *found,
                     const int orders, const int row, const int col, const float side_m) {
    const int pixel = sample_pixel(grid, row, col);
    const float3 position = positions[pixel].xyz, normal = normals[pixel].xyz;
    int lender = NOT_STORED;
    float nearest = INFINITY;
    for (int y = max(row - BLOCK + 1, 0); y < min(row + BLOCK, grid.rows); y++)
        for (int x = max(col - BLOCK + 1, 0); x < min(col + BLOCK, grid.cols); x++) {
            const int sample = y * grid.cols + x, at = sample_pixel(grid, y, x);
            if (found[sample] == NOT_STORED && order_of_new(y, x) >= orders) continue;
            const float4 there = positions[at];
            const float3 offset = there.xyz - position;
            const float apart = dot(offset, offset);
            if (there.w <= 0.0f || normals[at].w <= 0.0f || apart >= nearest || fabs(dot(offset, normal)) > side_m ||
                dot(normals[at].xyz, normal) < FACING)
                continue;
            lender = sample;
            nearest = apart;
        }
    return lender;
}

// Which samples are traced: all where p.most is not less than there are; else p.most, new ones first, in an order that covers the picture
// evenly, then one of each entry that is too old. New ones that wait take the values of one beside them; where none is on the same
// surface, they are traced, too. The others keep what the entry has. New samples that are traced ask for a place: the one that was not
// found for the longest time, but none that was found in this frame. Surfaces in one cell that face several ways may have an entry each.
// Samples that ask for the same place agree on the first of them. found, counts, claims: of find_samples. -> kept [rows][cols]: the place
// of a sample's entry, LENT + the sample whose values it takes; of those that are traced NOT_STORED, or -2 - place where one asks for a
// place. The last of counts: how many samples and entries wait.
kernel void choose_samples(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals,
                           global const uint *entries, global const int *found, global int *counts, global uint *claims,
                           global int *kept) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    const int there = found[sample];
    kept[sample] = there;
    if (there >= 0 || position.w <= 0.0f || normal.w <= 0.0f) return;
    const int orders = orders_in(counts, p.most);
    if (there != NOT_STORED) {
        const int place = -2 - there, is_first = claims[place] == (uint)sample;
        if (p.most >= p.grid.rows * p.grid.cols) return;
        if (is_first && order_of_old(place, p.now) < orders_in(counts + ORDERS, p.most - sum_of(counts, orders))) return;
        kept[sample] = place;
        if (!is_first) return;
        claims[place] = UINT_MAX;
        atomic_inc(&counts[2 * ORDERS]);
        return;
    }
    const Cell cell = cell_of(p.eye.xyz, p.spacing, p.places, position.xyz, normal.xyz);
    if (order_of_new(row, col) >= orders) {
        const int lender = lender_of(p.grid, positions, normals, found, orders, row, col, cell.side_m);
        if (lender != NOT_STORED) {
            kept[sample] = LENT + lender;
            atomic_inc(&counts[2 * ORDERS]);
            return;
        }
    }
    int place = NOT_STORED, oldest = p.now;
    for (int way = 0; way < WAYS; way++) {
        const int used = (int)entries[(size_t)cell.places[way] * WORDS + USED];
        if (used >= oldest) continue;
        oldest = used;
        place = cell.places[way];
    }
    if (place == NOT_STORED) return;
    kept[sample] = -2 - place;
    atomic_min(&claims[place], (uint)sample);
}

#ifdef IS_TRACED
#define NOTICED 8  // one of so many rays must have changed: at the edges of what is seen some always do, as the scan gets better

// Whether rays of an entry are free that were blocked, or blocked that were free: of those that are due, one of p.parts in turn. They
// begin where they began, so that in a volume that is the same they end the same.
static int opens_or_closes(const TransferCacheParameters p, const Volume volume, const float3 origin_m, global const float4 *directions,
                           global const uint *entry, const int part) {
    uint asked[MASK_WORDS], free[MASK_WORDS], blocked[MASK_WORDS];
    for (int i = 0; i < MASK_WORDS; i++) asked[i] = free[i] = blocked[i] = 0;
    for (int j = part; j < p.count; j += p.parts) asked[j >> 5] |= 1u << (j & 31);
    trace_hemisphere(volume, origin_m, vector_in(entry, RISE), directions, p.count, p.ray_length_m, asked, free, blocked);
    int changed = 0, traced = 0;
    for (int i = 0; i < MASK_WORDS; i++) {
        traced += popcount(free[i] | blocked[i]);
        changed += popcount((free[i] & ~entry[MASK_AT + i]) | (blocked[i] & entry[MASK_AT + i]));
    }
    return changed > 0 && NOTICED * changed >= traced;
}

// Whether surface that an entry's rays met is elsewhere along them, by more than the truncation, or nowhere.
static int has_moved(const TransferCacheParameters p, const Volume volume, const float3 origin_m, global const float4 *directions,
                     global const uint *met) {
    int count = 0, moved = 0;
    while (count < p.met && met[count] != NO_MORE_MET) count++;
    for (int first = 0; first < count; first += LANES) {
        int chosen[LANES];
        float distance_m[LANES];
        for (int lane = 0; lane < LANES; lane++) chosen[lane] = direction_of_met(met[min(first + lane, count - 1)]);
        meet(volume, origin_m, directions, chosen, p.ray_length_m, distance_m);
        for (int lane = 0; lane < min(LANES, count - first); lane++)
            moved += fabs(distance_m[lane] - distance_of_met(met[first + lane])) > volume.truncation_m;
    }
    return moved > 0 && NOTICED * moved >= count;
}

static int has_changed(const TransferCacheParameters p, const Volume volume, global const float4 *directions, global const uint *entry,
                       const int place) {
    global const float4 *own = directions + (int)entry[SET] * p.count;
    const float3 position = vector_in(entry, POSITION);
    return opens_or_closes(p, volume, position + volume.voxel_m * vector_in(entry, RISE), own, entry, (place + p.now) / p.checks % p.parts) ||
           has_moved(p, volume, position + volume.voxel_m * vector_in(entry, NORMAL), own, entry + MET);
}
#endif

// Arguments as in find_samples and choose_samples; the arrays of samples now hold values of this frame, but those of samples that take
// the values of others. The first traced frame of a cell is told earlier by a part of the period, so that cells do not all become too old
// at once. disc_frames [places]: see shadow_map.cl; 0 where an entry is new. -> kept: the place of the sample's entry, else NOT_STORED;
// ways [rows][cols]: see ways.clh. With IS_TRACED, entries whose turn it is are checked: one that has_changed is too old from the next
// frame on. mean_normals [rows][cols]: of samples that were traced; the rest: as of transfer_radiance.
kernel void store_samples(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals, global uint *entries,
                          global float *transfer, global float *openness, global float *flatness, global uint *free_mask, global uchar *sets,
                          global float4 *hits, global uint *met, global uint *claims, global int *disc_frames, global int *kept,
                          global uchar *ways
#ifdef IS_TRACED
                          , global const float4 *mean_normals, const VolumeShape shape, global const int *slots,
                          global const ulong *solid, global const uchar *octets, global const float4 *directions
#endif
) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    ways[sample] = kept[sample] >= LENT ? OF_ANOTHER : kept[sample] >= 0 ? AS_KEPT : ANEW;
    if (kept[sample] >= LENT) {
        const int lender = kept[sample] - LENT;
        for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = transfer[lender * COEFFICIENTS + i];
        for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = free_mask[lender * MASK_WORDS + i];
        for (int i = 0; i < MOST_MET; i++) met[sample * MOST_MET + i] = met[lender * MOST_MET + i];
        openness[sample] = openness[lender];
        flatness[sample] = flatness[lender];
        sets[sample] = sets[lender];
        hits[sample] = hits[lender];
        kept[sample] = NOT_STORED;
    }
    if (kept[sample] == NOT_STORED) return;
    const int is_found = kept[sample] >= 0, place = is_found ? kept[sample] : -2 - kept[sample];
    const int is_first = claims[place] == (uint)sample;
    if (!is_found) kept[sample] = is_first ? place : NOT_STORED;
    if (!is_first) return;
    claims[place] = UINT_MAX;
    global uint *entry = entries + (size_t)place * WORDS;
    if (is_found) {
#ifdef IS_TRACED
        const Volume volume = make_volume(shape, slots, solid, octets, 0);
        if (has_changed(p, volume, directions, entry, place)) entry[TRACED] = (uint)(p.now - p.period);
#endif
        return;
    }
    disc_frames[place] = 0;
    const float3 position = positions[pixel].xyz, normal = normals[pixel].xyz;
    const Cell cell = cell_of(p.eye.xyz, p.spacing, p.places, position, normal);
    const int is_known = is_of(entry, cell, position, normal);
    entry[KEY] = cell.key.x;
    entry[KEY + 1] = cell.key.y;
    entry[TRACED] = (uint)(p.now - (is_known ? 0 : (int)(mixed(cell.key.x + cell.key.y) % (uint)p.period)));
    entry[USED] = (uint)p.now;
    entry[SET] = sets[sample];
    const float of_sample[8] = {position.x, position.y, position.z, normal.x, normal.y, normal.z, openness[sample], flatness[sample]};
    for (int i = 0; i < 8; i++) entry[POSITION + i] = as_uint(of_sample[i]);
    const float4 sent = hits[sample];
    const float of_hits[4] = {sent.x, sent.y, sent.z, sent.w};
    for (int i = 0; i < 4; i++) entry[HITS + i] = as_uint(of_hits[i]);
#ifdef IS_TRACED
    const float3 rise = mean_normals[sample].xyz;
    const float of_rise[3] = {rise.x, rise.y, rise.z};
    for (int i = 0; i < 3; i++) entry[RISE + i] = as_uint(of_rise[i]);
#endif
    for (int i = 0; i < MASK_WORDS; i++) entry[MASK_AT + i] = free_mask[sample * MASK_WORDS + i];
    for (int i = 0; i < MOST_MET; i++) entry[MET + i] = met[sample * MOST_MET + i];
    for (int i = 0; i < COEFFICIENTS; i++) entry[TRANSFER + i] = as_uint(transfer[sample * COEFFICIENTS + i]);
}
