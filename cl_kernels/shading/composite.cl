// Compositing (thesis 7.2.1, R3) with mutual occlusion of real and virtual surface; linear radiance, encoded as sRGB at the end.
// Provides composite.
#include "composite_inputs.clh"

// codes [65536]: sRGB code of linear radiance i / 65535.
static inline void write_color(global uchar *picture, const int pixel, const float3 linear, global const uchar *codes) {
    const float3 level = clamp(linear, 0.0f, 1.0f) * 65535.0f + 0.5f;
    picture[3 * pixel] = codes[(int)level.x];
    picture[3 * pixel + 1] = codes[(int)level.y];
    picture[3 * pixel + 2] = codes[(int)level.z];
}

static inline void copy_codes(global const uchar *shown, global uchar *picture, const int pixel) {
#if LANES == 8
    for (int i = 0; i < 3; i++) vstore8(vload8(i, shown + 3 * pixel), i, picture + 3 * pixel);
#else
    for (int i = 0; i < 3 * LANES; i++) picture[3 * pixel + i] = shown[3 * pixel + i];
#endif
}

// shown [h][w][3]: the camera picture as sRGB codes. codes [65536]: sRGB code of linear radiance i / 65535.
// One item LANES pixels of a row -> picture [h][w][3] sRGB. Pixels without virtual content keep the camera's bytes.
kernel void composite(const MixtureParameters parameters, MIXTURE_BUFFERS, global const uchar *shown, global const uchar *codes,
                      global uchar *picture) {
    const int first = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    const int width = parameters.real_samples.width;
    if (first >= width || y >= parameters.height) return;
    const Mixture mixture = MIXTURE_OF_BUFFERS(parameters);
    if (first + LANES <= width && !may_change(mixture, first, y)) {
        copy_codes(shown, picture, y * width + first);
        return;
    }
    float4 factors[LANES];
    factors_of(mixture, first, y, factors);
    for (int x = first; x < min(first + LANES, width); x++) {
        const int pixel = y * width + x;
        const Mixed mixed = mixed_at(mixture, x, y, factors[x - first]);
        float3 color = radiance[pixel].xyz;
        if (mixed.is_touched) color = color * mixed.factor;
        if (mixed.part > 0.0f) color = color + mixed.part * (mixed.own - color);
        if (mixed.is_touched || mixed.part > 0.0f)
            write_color(picture, pixel, color, codes);
        else
            for (int i = 0; i < 3; i++) picture[3 * pixel + i] = shown[3 * pixel + i];
    }
}
