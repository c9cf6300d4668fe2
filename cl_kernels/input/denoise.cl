// Denoising of lightness and depth (thesis 5.1.1): CIE L*, TV-L1 (its [120]) and a bilateral filter.
// Provides measure_lightness, relight, tv_l1_prepare, tv_l1_strips, tv_l1_dual, tv_l1_primal, tv_l1_finish, pad, bilateral.
// Eight pixels of a row are one float8: PoCL vectorises little else. Intermediate images are [rows][stride], stride a multiple
// of 8.

#define KNEE (6.0f / 29.0f)  // CIE 15: L* is a cube root above KNEE^3 and a line below

static inline float8 luminance_of(global const float4 *rgb) {
    const float4 w = (float4)(0.2126f, 0.7152f, 0.0722f, 0.0f);  // Rec. 709
    return (float8)(dot(rgb[0], w), dot(rgb[1], w), dot(rgb[2], w), dot(rgb[3], w),
                    dot(rgb[4], w), dot(rgb[5], w), dot(rgb[6], w), dot(rgb[7], w));
}

// Cube root of positive normal numbers to 2 ulp: a third of the exponent, then Halley's step twice, each cubing the error.
static inline float8 cube_root(const float8 x) {
    float8 y = as_float8(as_uint8(x) / 3u + 709921077u);
    for (int step = 0; step < 2; step++) {
        const float8 cube = y * y * y;
        y *= (cube + 2.0f * x) / (2.0f * cube + x);
    }
    return y;
}

static inline float8 lightness_of(const float8 luminance) {
    const float8 root = cube_root(max(luminance, KNEE * KNEE * KNEE));
    const float8 line = (luminance - KNEE * KNEE * KNEE) / (3.0f * KNEE * KNEE);
    return 1.16f * (root + min(line, 0.0f)) - 0.16f;
}

static inline float8 luminance_from(const float8 lightness) {
    const float8 root = (lightness + 0.16f) / 1.16f;
    const float8 cube = max(root, KNEE) * max(root, KNEE) * max(root, KNEE);
    return cube + 3.0f * KNEE * KNEE * min(root - KNEE, 0.0f);
}

// One item 8 of the `count` (8 or more) pixels; the last item may overlap the one before.
// radiance [count] (rgb linear, w > 0 usable) -> lightness [count]: L* / 100, -1 where not usable.
kernel void measure_lightness(const int count, global const float4 *radiance, global float *lightness) {
    if (8 * (int)get_global_id(0) >= count) return;
    const int first = min(8 * (int)get_global_id(0), count - 8);
    global const float4 *r = radiance + first;
    const float8 usable = (float8)(r[0].w, r[1].w, r[2].w, r[3].w, r[4].w, r[5].w, r[6].w, r[7].w);
    vstore8(select((float8)(-1.0f), lightness_of(luminance_of(r)), usable > 0.0f), 0, lightness + first);
}

// Items as above. radiance [count], lightness [count] -> relit [count]: usable colours scaled to the lightness.
kernel void relight(const int count, global const float4 *radiance, global const float *lightness, global float4 *relit) {
    if (8 * (int)get_global_id(0) >= count) return;
    const int first = min(8 * (int)get_global_id(0), count - 8);
    const float8 seen = max(luminance_of(radiance + first), 1e-9f);
    float ratio[8];
    vstore8(max(luminance_from(vload8(0, lightness + first)), 0.0f) / seen, 0, ratio);
    for (int k = 0; k < 8; k++) {
        const float4 here = radiance[first + k];
        relit[first + k] = here.w > 0.0f ? (float4)(ratio[k] * here.xyz, here.w) : here;
    }
}

// TV-L1: min over u of sum |grad u| + weight sum |u - f|, by the primal-dual scheme of Chambolle and Pock 2011 (algorithm 1, theta 1):
//   p = project(p + sigma grad(ahead)), u' = prox(u + tau div p), ahead = 2 u' - u;  limit = tau weight.
// The gradient is forward differences between joined pixels: bit RIGHT or BELOW of `joined`.
#define RIGHT 1
#define BELOW 2

typedef struct {
    global float *u, *ahead, *px, *py;
} State;

// One item a pixel of [height][stride]. image [height][width], unknown at or below `none`; neighbours that differ by more than
// `edge` are not joined -> f, joined, the first state.
kernel void tv_l1_prepare(const int width, const int height, const int stride, global const float *image, const float none,
                          const float edge, global float *f, global uchar *joined,
                          global float *u, global float *ahead, global float *px, global float *py) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= stride || y >= height) return;
    const int i = y * stride + x;
    const int pixel = y * width + x;
    const float value = x < width ? image[pixel] : 0.0f;
    const float next = x + 1 < width ? image[pixel + 1] : none;
    const float under = x < width && y + 1 < height ? image[pixel + width] : none;
    const int here = x < width && value > none;
    const int right = here && next > none && fabs(next - value) <= edge;
    const int below = here && under > none && fabs(under - value) <= edge;
    f[i] = value;
    u[i] = value;
    ahead[i] = value;
    px[i] = 0.0f;
    py[i] = 0.0f;
    joined[i] = (right ? RIGHT : 0) | (below ? BELOW : 0);
}

// v where the bit of `joined` is set, else 0, whatever v is.
static inline float8 where_joined(const uchar8 joined, const int bit, const float8 v) {
    return as_float8(((convert_int8(joined) & bit) != 0) & as_int8(v));
}

// One iteration over rows [first, last) of `from` into `to`, which may be the same: values are read before they are replaced.
// The dual field of the row above, which belongs to a neighbour, is computed in `margin`.
static inline void iterate(const int stride, const int height, const int first, const int last, global const float *f,
                           global const uchar *joined, const float tau, const float sigma, const float limit,
                           const State from, const State to, const State margin) {
    for (int y = max(first - 1, 0); y < last; y++) {
        const int below = min(y + 1, height - 1) * stride;
        const int kept = y >= first;
        global float *px_row = kept ? to.px : margin.px;
        global float *py_row = kept ? to.py : margin.py;
        global const float *py_above = y > first ? to.py : margin.py;
        float px_left = 0.0f;
        for (int x = 0; x < stride; x += 8) {
            const int i = y * stride + x;
            const uchar8 links = vload8(0, joined + i);
            const float8 here = vload8(0, from.ahead + i);
            const float8 dx = where_joined(links, RIGHT, vload8(0, from.ahead + i + 1) - here);
            const float8 dy = where_joined(links, BELOW, vload8(0, from.ahead + below + x) - here);
            const float8 long_px = vload8(0, from.px + i) + sigma * dx;
            const float8 long_py = vload8(0, from.py + i) + sigma * dy;
            const float8 shrink = 1.0f / sqrt(max(long_px * long_px + long_py * long_py, 1.0f));
            const float8 px = long_px * shrink;
            const float8 py = long_py * shrink;
            vstore8(px, 0, px_row + i);
            vstore8(py, 0, py_row + i);
            if (kept) {
                const float8 above = y > 0 ? vload8(0, py_above + i - stride) : (float8)(0.0f);
                const float8 left = (float8)(px_left, px.s0123, px.s456);
                const float8 old = vload8(0, from.u + i);
                const float8 moved = old + tau * (px - left + py - above);
                const float8 u = moved - clamp(moved - vload8(0, f + i), -limit, limit);
                vstore8(u, 0, to.u + i);
                vstore8(2.0f * u - old, 0, to.ahead + i);
            }
            px_left = px.s7;
        }
    }
}

// `steps` iterations in one pass over memory, for CPUs: one item a strip of `rows` rows, whose state between the first and the
// last iteration is in its own part of `scratch` [strips][4][rows + 2 steps + 1][stride]. Rows within `steps` of a strip's edge
// are computed by both strips. Arrays are [height + 1][stride]; the row after the last is read, but not used.
kernel void tv_l1_strips(const int stride, const int height, const int rows, const int steps, global const float *f,
                         global const uchar *joined, const float tau, const float sigma, const float limit,
                         global float *u, global float *ahead, global float *px, global float *py, global float *scratch,
                         global float *new_u, global float *new_ahead, global float *new_px, global float *new_py) {
    const int strip = get_global_id(0);
    const int first = strip * rows;
    if (first >= height) return;
    const int last = min(first + rows, height);
    const int plane = (rows + 2 * steps + 1) * stride;
    global float *own = scratch + strip * 4 * plane - max(first - steps, 0) * stride;  // so that indices are the picture's
    const State in = {u, ahead, px, py};
    const State inner = {own, own + plane, own + 2 * plane, own + 3 * plane};
    const State out = {new_u, new_ahead, new_px, new_py};
    for (int spare = steps - 1; spare >= 0; spare--) {
        const State from = spare == steps - 1 ? in : inner;
        const State to = spare == 0 ? out : inner;
        iterate(stride, height, max(first - spare, 0), min(last + spare, height), f, joined, tau, sigma, limit, from, to, inner);
    }
}

// The same iteration in two passes, one item a pixel, for GPUs.
kernel void tv_l1_dual(const int stride, const int height, global const uchar *joined, const float sigma,
                       global const float *ahead, global float *px, global float *py) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= stride || y >= height) return;
    const int i = y * stride + x;
    const float dx = joined[i] & RIGHT ? ahead[i + 1] - ahead[i] : 0.0f;
    const float dy = joined[i] & BELOW ? ahead[i + stride] - ahead[i] : 0.0f;
    const float long_px = px[i] + sigma * dx;
    const float long_py = py[i] + sigma * dy;
    const float shrink = 1.0f / sqrt(fmax(long_px * long_px + long_py * long_py, 1.0f));
    px[i] = long_px * shrink;
    py[i] = long_py * shrink;
}

kernel void tv_l1_primal(const int stride, const int height, global const float *f, const float tau, const float limit,
                         global const float *px, global const float *py, global float *u, global float *ahead) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= stride || y >= height) return;
    const int i = y * stride + x;
    const float left = x > 0 ? px[i - 1] : 0.0f;
    const float above = y > 0 ? py[i - stride] : 0.0f;
    const float moved = u[i] + tau * (px[i] - left + py[i] - above);
    const float value = moved - clamp(moved - f[i], -limit, limit);
    ahead[i] = 2.0f * value - u[i];
    u[i] = value;
}

kernel void tv_l1_finish(const int width, const int height, const int stride, global const float *u, global float *image) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x < width && y < height) image[y * width + x] = u[y * stride + x];
}

// Bilateral filter (Tomasi and Manduchi 1998) with Tukey's weight (1 - r^2)^2 of the difference instead of a Gaussian. The
// weight is 0 beyond a finite width, so that edges do not leak and the value of no measurement needs no test.
#define RADIUS 3
#define MARGIN 8

// One item a pixel of padded [height + 2 RADIUS][stride]: image [height][width], and `none` around it.
kernel void pad(const int width, const int height, const int stride, global const float *image, const float none,
                global float *padded) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    if (x >= stride || y >= height + 2 * RADIUS) return;
    const int u = x - MARGIN, v = y - RADIUS;
    const int inside = u >= 0 && v >= 0 && u < width && v < height;
    padded[y * stride + x] = inside ? image[v * width + u] : none;
}

// One item 8 pixels of a row. range_width.s0 + range_width.s1 (value - range_width.s2)^2: the difference at which the weight
// becomes 0. closeness [2 RADIUS + 1][2 RADIUS + 1]: weight by position. padded: see pad -> filtered [height][width]. At `none`
// the width is almost 0, so that it stays `none`.
kernel void bilateral(const int width, const int height, const int stride, global const float *padded,
                      constant float *closeness, const float4 range_width, const float none, global float *filtered) {
    const int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= width || y >= height) return;
    global const float *center = padded + (y + RADIUS) * stride + MARGIN + x;
    const float8 here = vload8(0, center);
    const float8 away = here - range_width.s2;
    const float8 inverse = 1.0f / max(min(range_width.s0 + range_width.s1 * away * away, 0.5f * (here - none)), 1e-6f);
    float8 moved = 0.0f, total = 0.0f;
    for (int dy = -RADIUS; dy <= RADIUS; dy++) {
        for (int dx = -RADIUS; dx <= RADIUS; dx++) {
            const float8 difference = vload8(0, center + dy * stride + dx) - here;
            const float8 r = difference * inverse;
            const float8 falling = max(1.0f - r * r, 0.0f);
            const float8 weight = closeness[(dy + RADIUS) * (2 * RADIUS + 1) + dx + RADIUS] * falling * falling;
            moved += weight * difference;
            total += weight;
        }
    }
    float result[8];
    vstore8(here + moved / total, 0, result);
    for (int k = 0; k < min(8, width - x); k++) filtered[y * width + x + k] = result[k];
}
