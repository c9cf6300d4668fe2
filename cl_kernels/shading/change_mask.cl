// Cells of the picture that virtual objects change visibly (thesis 7.1): R' / R is applied there, and 1 elsewhere.
// Provides mark_reached.
#include "upsample.clh"

#define WINDOW 6    // samples along each side that a cell's pixels are means of
#define CORNERS 3   // places along a side of a cell between which means of boxes change linearly: its ends and its centre

// Weights of the box of upsample.clh at these places; sample 2 is the one at the cell's beginning.
constant float BOX[CORNERS][WINDOW] = {{0.5f, 1.0f, 1.0f, 1.0f, 0.5f, 0.0f},
                                       {0.0f, 1.0f, 1.0f, 1.0f, 1.0f, 0.0f},
                                       {0.0f, 0.5f, 1.0f, 1.0f, 1.0f, 0.5f}};

// How far a valid ratio is from 1.
static inline float change_of(const float4 ratio) {
    const float3 change = fabs(ratio.xyz - 1.0f);
    return ratio.w > 0.0f ? fmax(fmax(change.x, change.y), change.z) : 0.0f;
}

// A plane through `point` that approximates several surface points.
typedef struct {
    float3 point;
    float3 normal;
    float off_m;    // the greatest distance from the plane
    float cosine;   // the least of normals to its own
    float apart_m;  // the greatest distance from `point`
} Flat;

static inline void take_in(Flat *flat, const float3 point, const float3 normal) {
    const float3 offset = point - flat->point;
    flat->off_m = fmax(flat->off_m, fabs(dot(flat->normal, offset)));
    flat->cosine = fmin(flat->cosine, dot(flat->normal, normal));
    flat->apart_m = fmax(flat->apart_m, length(offset));
}

// Lower bound of the weights between any two of these points in upsampling, without the box: see weight_of. Two normals are no more
// than twice as far apart as each is from the plane's, and a point is off another's plane by no more than off its own and by how
// much that is tilted.
static inline float least_weight(const Flat flat, const float tolerance_m) {
    const float facing = fmax(2.0f * flat.cosine * fabs(flat.cosine) - 1.0f, 0.0f);
    const float tilt = sqrt(fmax(2.0f - 2.0f * flat.cosine, 0.0f));
    const float off = 2.0f * (flat.off_m + tilt * flat.apart_m) / tolerance_m;
    return facing * facing * facing * facing / (1.0f + off * off * off * off);
}

// Greatest mean change over boxes around the cell's places, if all surface were one plane; undefined without surface.
static float greatest_mean(const Grid grid, global const float4 *ratio, const int first_row, const int first_col) {
    float changes[CORNERS][CORNERS], weights[CORNERS][CORNERS];
    for (int i = 0; i < CORNERS * CORNERS; i++) changes[i / CORNERS][i % CORNERS] = weights[i / CORNERS][i % CORNERS] = 0.0f;
    for (int r = 0; r < WINDOW; r++) {
        const int row = first_row + r;
        if (row < 0 || row >= grid.rows) continue;
        float of_row[CORNERS] = {0.0f, 0.0f, 0.0f}, counts[CORNERS] = {0.0f, 0.0f, 0.0f};
        for (int c = max(-first_col, 0); c < min(WINDOW, grid.cols - first_col); c++) {
            const float4 value = ratio[row * grid.cols + first_col + c];
            const float change = change_of(value), valid = value.w > 0.0f ? 1.0f : 0.0f;
            for (int u = 0; u < CORNERS; u++) {
                of_row[u] += BOX[u][c] * change;
                counts[u] += BOX[u][c] * valid;
            }
        }
        for (int v = 0; v < CORNERS; v++) {
            for (int u = 0; u < CORNERS; u++) {
                changes[v][u] += BOX[v][r] * of_row[u];
                weights[v][u] += BOX[v][r] * counts[u];
            }
        }
    }
    float greatest = 0.0f;
    for (int v = 0; v < CORNERS; v++)
        for (int u = 0; u < CORNERS; u++) greatest = fmax(greatest, changes[v][u] / fmax(weights[v][u], 1e-6f));
    return greatest;
}

// ratio [rows][cols] (w = 1 valid): R' / R at samples of real surface; positions, normals [height][width] of it; refined [height][width]:
// replaces `ratio` where w = 1, or none where has_refined is 0. -> reached [rows + 1][cols + 1]: 0 where no pixel of a cell
// (see upsample.clh) has a mean that is farther from 1 than `spare`, and none that is not exactly 1 is refined.
//
// A mean is no farther from 1 than the farthest sample. Where all surface of the cell and of its samples is about one plane, no
// sample counts less than a share of the box's weight, and the mean is no farther than that over the box, over that share.
kernel void mark_reached(const int cols, const int rows, const int stride, const int width, const int height,
                         global const float4 *positions, global const float4 *normals, global const float4 *ratio,
                         const int has_refined, global const float4 *refined, const float tolerance_m, const float spare,
                         global uchar *reached) {
    const int cell_col = (int)get_global_id(0) - 1;
    const int cell_row = (int)get_global_id(1) - 1;
    if (cell_col >= cols || cell_row >= rows) return;
    const Grid grid = {cols, rows, stride, width};
    const int first_row = cell_row - 2, first_col = cell_col - 2;
    const int last_row = min(first_row + WINDOW, rows), last_col = min(first_col + WINDOW, cols);
    float most = 0.0f;
    int known = -1;  // the pixel of a sample of real surface
    for (int row = max(first_row, 0); row < last_row; row++) {
        for (int col = max(first_col, 0); col < last_col; col++) {
            const float4 value = ratio[row * cols + col];
            most = fmax(most, change_of(value));
            if (value.w > 0.0f && (known < 0 || (row <= cell_row && col <= cell_col)))
                known = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
        }
    }
    float mean = most;
#ifndef BICUBIC
    if (most > spare && spare > 0.0f) mean = greatest_mean(grid, ratio, first_row, first_col);
#endif
    int counts = mean > spare;
    const int hangs_on_surface = !counts && most > spare;
    if (!counts && most > 0.0f && (hangs_on_surface || has_refined)) {
        const int x0 = stride / 2 + cell_col * stride, y0 = stride / 2 + cell_row * stride;
        Flat flat = {positions[known].xyz, normals[known].xyz, 0.0f, 1.0f, 0.0f};
        for (int y = max(y0, 0); y < min(y0 + stride, height); y++) {
            for (int x = max(x0, 0); x < min(x0 + stride, width); x++) {
                const float4 position = positions[y * width + x];
                if (position.w <= 0.0f) continue;
                take_in(&flat, position.xyz, normals[y * width + x].xyz);
                counts |= has_refined && refined[y * width + x].w > 0.0f;
            }
        }
        for (int row = max(first_row, 0); hangs_on_surface && row < last_row; row++) {
            for (int col = max(first_col, 0); col < last_col; col++) {
                const int pixel = (stride / 2 + row * stride) * width + stride / 2 + col * stride;
                if (ratio[row * cols + col].w > 0.0f) take_in(&flat, positions[pixel].xyz, normals[pixel].xyz);
            }
        }
        counts |= hangs_on_surface && !(mean <= spare * least_weight(flat, tolerance_m));
    }
    reached[(cell_row + 1) * (cols + 1) + cell_col + 1] = (uchar)counts;
}
