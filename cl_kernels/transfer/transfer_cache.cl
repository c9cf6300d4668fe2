// Radiance transfer that earlier frames found at places of the world, in a hash table of cells.
// Provides find_samples, claim_entries, store_samples.
//
// A cell is about as large as the distance between samples there, so that a sample of the next frame finds what one of this frame left.
// Two places of the table are tried for a cell. Which sample fills a place depends on the numbers of the samples only, not on
// the order in which work-items run.
#include "samples.clh"

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

#define WAYS 2
#define FLAT 2.0f    // height of a cell along the axis that its surface faces, in sides: noise of the surface rarely leaves it
#define FACING 0.8f  // least cosine between normals of one surface
#define NOT_STORED (-1)

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
#define LASTS 17   // frames after which it is traced again
#define MASK_AT 18
#define TRANSFER (MASK_AT + MASK_WORDS)
#define MET (TRANSFER + COEFFICIENTS)
#define WORDS (MET + MOST_MET)

typedef struct {
    uint2 key;
    float side_m;
    int places[WAYS];
} Cell;

static inline uint mixed(uint h) {
    h ^= h >> 16;
    h *= 0x7feb352du;
    h ^= h >> 15;
    h *= 0x846ca68bu;
    return h ^ (h >> 16);
}

// Sides of cells grow by factors of sqrt(2) with the distance between samples, and are at least sqrt(2) as long.
static Cell cell_of(const TransferCacheParameters p, const float3 position, const float3 normal) {
    const int level = (int)ceil(2.0f * log2(fmax(distance(position, p.eye.xyz) * p.spacing, 1e-4f))) + 1;
    Cell cell;
    cell.side_m = exp2(0.5f * (float)level);
    const float3 size = fabs(normal);
    const int axis = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
    const float along = axis == 0 ? normal.x : axis == 1 ? normal.y : normal.z;
    const float3 sides = cell.side_m * (float3)(axis == 0 ? FLAT : 1.0f, axis == 1 ? FLAT : 1.0f, axis == 2 ? FLAT : 1.0f);
    const int3 at = convert_int3(floor(position / sides));
    const uint facing = (uint)(2 * axis + (along < 0.0f));
    cell.key = (uint2)(((uint)at.x & 0xfffffu) | facing << 20 | 1u << 23 | (uint)(level + 64) << 24,
                       ((uint)at.y & 0xffffu) | ((uint)at.z & 0xffffu) << 16);
    const uint hash = mixed(cell.key.x ^ mixed(cell.key.y));
    cell.places[0] = (int)(hash & (uint)(p.places - 1));
    cell.places[1] = (int)(mixed(hash + 0x9e3779b9u) & (uint)(p.places - 1));
    return cell;
}

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

// positions, normals [h][w]: the geometry buffer; entries [places][WORDS]. -> found [rows][cols]: the place of a sample's entry,
// whose values are then in transfer, openness, flatness, free_mask, sets (see radiance_transfer.cl) hits and met (see indirect.cl); or
// NOT_STORED, where they are as they were.
kernel void find_samples(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals,
                         global uint *entries, global float *transfer, global float *openness, global float *flatness,
                         global uint *free_mask, global uchar *sets, global float4 *hits, global uint *met, global int *found) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    found[sample] = NOT_STORED;
    if (position.w <= 0.0f || normal.w <= 0.0f) return;
    const Cell cell = cell_of(p, position.xyz, normal.xyz);
    for (int way = 0; way < WAYS; way++) {
        global uint *entry = entries + (size_t)cell.places[way] * WORDS;
        if (!is_of(entry, cell, position.xyz, normal.xyz)) continue;
        if (p.now - (int)entry[TRACED] >= (int)entry[LASTS]) return;
        entry[USED] = (uint)p.now;
        for (int i = 0; i < COEFFICIENTS; i++) transfer[sample * COEFFICIENTS + i] = as_float(entry[TRANSFER + i]);
        for (int i = 0; i < MASK_WORDS; i++) free_mask[sample * MASK_WORDS + i] = entry[MASK_AT + i];
        for (int i = 0; i < MOST_MET; i++) met[sample * MOST_MET + i] = entry[MET + i];
        openness[sample] = as_float(entry[OPENNESS]);
        flatness[sample] = as_float(entry[FLATNESS]);
        sets[sample] = (uchar)entry[SET];
        hits[sample] = (float4)(vector_in(entry, HITS), as_float(entry[HITS + 3]));
        found[sample] = cell.places[way];
        return;
    }
}

// Samples that were not found ask for a place: that of their entry, which is too old, else the one that was not found for the longest
// time, but none that was found in this frame. Surfaces in one cell that face several ways may have an entry each. Samples that ask for the
// same place agree on the first of them. claims [places]: all UINT_MAX before. -> found: -2 - place where a sample asks for one.
kernel void claim_entries(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals,
                          global const uint *entries, global uint *claims, global int *found) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    const float4 position = positions[pixel], normal = normals[pixel];
    if (found[sample] != NOT_STORED || position.w <= 0.0f || normal.w <= 0.0f) return;
    const Cell cell = cell_of(p, position.xyz, normal.xyz);
    int place = NOT_STORED, oldest = p.now;
    for (int way = 0; way < WAYS; way++) {
        global const uint *entry = entries + (size_t)cell.places[way] * WORDS;
        if ((int)entry[USED] >= oldest) continue;
        oldest = (int)entry[USED];
        place = cell.places[way];
    }
    for (int way = WAYS - 1; way >= 0; way--)
        if (is_of(entries + (size_t)cell.places[way] * WORDS, cell, position.xyz, normal.xyz)) place = cell.places[way];
    if (place == NOT_STORED) return;
    found[sample] = -2 - place;
    atomic_min(&claims[place], (uint)sample);
}

// Arguments as in find_samples and claim_entries; the arrays of samples now hold values of this frame. The first traced frame of a
// cell is told earlier by a part of the period, so that cells do not all become too old at once. An entry of the same surface as before
// lasts twice as long, up to p.longest frames. disc_frames [places]: see
// shadow_map.cl; 0 where an entry is new. -> found: the place of the sample's entry, else NOT_STORED.
kernel void store_samples(const TransferCacheParameters p, global const float4 *positions, global const float4 *normals, global uint *entries,
                          global const float *transfer, global const float *openness, global const float *flatness,
                          global const uint *free_mask, global const uchar *sets, global const float4 *hits, global const uint *met,
                          global uint *claims, global int *disc_frames, global int *found) {
    const int col = get_global_id(0);
    const int row = get_global_id(1);
    if (col >= p.grid.cols || row >= p.grid.rows) return;
    const int sample = row * p.grid.cols + col, pixel = sample_pixel(p.grid, row, col);
    if (found[sample] >= NOT_STORED) return;
    const int place = -2 - found[sample];
    const int is_first = claims[place] == (uint)sample;
    found[sample] = is_first ? place : NOT_STORED;
    if (!is_first) return;
    claims[place] = 0xffffffffu;
    disc_frames[place] = 0;
    const float3 position = positions[pixel].xyz, normal = normals[pixel].xyz;
    const Cell cell = cell_of(p, position, normal);
    global uint *entry = entries + (size_t)place * WORDS;
    const int is_known = is_of(entry, cell, position, normal);
    const int lasts = is_known ? min(2 * (int)entry[LASTS], p.longest) : p.period;
    entry[KEY] = cell.key.x;
    entry[KEY + 1] = cell.key.y;
    entry[TRACED] = (uint)(p.now - (is_known ? 0 : (int)(mixed(cell.key.x + cell.key.y) % (uint)p.period)));
    entry[USED] = (uint)p.now;
    entry[LASTS] = (uint)lasts;
    entry[SET] = sets[sample];
    const float kept[8] = {position.x, position.y, position.z, normal.x, normal.y, normal.z, openness[sample], flatness[sample]};
    for (int i = 0; i < 8; i++) entry[POSITION + i] = as_uint(kept[i]);
    const float4 sent = hits[sample];
    const float of_hits[4] = {sent.x, sent.y, sent.z, sent.w};
    for (int i = 0; i < 4; i++) entry[HITS + i] = as_uint(of_hits[i]);
    for (int i = 0; i < MASK_WORDS; i++) entry[MASK_AT + i] = free_mask[sample * MASK_WORDS + i];
    for (int i = 0; i < MOST_MET; i++) entry[MET + i] = met[sample * MOST_MET + i];
    for (int i = 0; i < COEFFICIENTS; i++) entry[TRANSFER + i] = as_uint(transfer[sample * COEFFICIENTS + i]);
}
