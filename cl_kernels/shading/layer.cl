// The virtual layer without the camera's picture (thesis 7.2.1), for clients that compose it with a later picture.
// Provides compose_layer.
#include "composite_inputs.clh"

#define NEUTRAL 128  // code of a factor of 1

// Code of a camera depth: 0 means empty, so depths below half a unit have code 1; too large ones the last code.
static inline ushort depth_code(const float z, const float depth_scale_m) {
    return (ushort)clamp(z / depth_scale_m + 0.5f, 1.0f, 65535.0f);
}

// Code of the square root, so that dark shadows have enough codes.
static inline uchar ratio_code(const float factor) {
    return (uchar)clamp(NEUTRAL * sqrt(factor) + 0.5f, 0.0f, 255.0f);
}

static inline ushort depth_at(global const float4 *positions, const int pixel, const float16 camera_from_volume,
                              const float depth_scale_m) {
    const float4 position = positions[pixel];
    return position.w > 0.0f ? depth_code(transform_point(camera_from_volume, position.xyz).z, depth_scale_m) : (ushort)0;
}

static inline void clear(global uchar4 *virtual_layer, global ushort *virtual_depth, global uchar *ratio_layer, const int pixel) {
#ifdef HAS_OBJECTS
    virtual_layer[pixel] = (uchar4)(0);
    virtual_depth[pixel] = 0;
#endif
#ifdef HAS_SHADOWS
    for (int i = 0; i < 3; i++) ratio_layer[3 * pixel + i] = NEUTRAL;
#endif
}

// codes [65536]: sRGB code of linear radiance i / 65535; depth_scale_m: metres of a unit of depth.
// One item LANES pixels of a row -> layer, a buffer of four arrays. virtual_layer [h][w]: sRGB codes and coverage, 255: all;
// virtual_depth [h][w] of the surface that the colour is of; neither is written without HAS_OBJECTS. ratio_layer [h][w][3]: codes of
// factors; real_depth [h][w] of all real surface; neither is written without HAS_SHADOWS.
kernel void compose_layer(const LayerParameters parameters, MIXTURE_BUFFERS, global const uchar *codes, global uchar *layer) {
    const int first = get_global_id(0) * LANES;
    const int y = get_global_id(1);
    const int width = parameters.mixture.real_samples.width;
    if (first >= width || y >= parameters.mixture.height) return;
    const Mixture mixture = MIXTURE_OF_BUFFERS(parameters.mixture);
    const float16 camera_from_volume = parameters.mixture.camera_from_volume;
    const float depth_scale_m = parameters.depth_scale_m;
    global uchar4 *virtual_layer = (global uchar4 *)layer;
    global ushort *virtual_depth = (global ushort *)(layer + parameters.virtual_depth_at);
    global uchar *ratio_layer = layer + parameters.ratio_at;
    const int end = min(first + LANES, width);
    for (int x = first; x < end; x++) {
        clear(virtual_layer, virtual_depth, ratio_layer, y * width + x);
#ifdef HAS_SHADOWS
        global ushort *real_depth = (global ushort *)(layer + parameters.real_depth_at);
        real_depth[y * width + x] = depth_at(positions, y * width + x, camera_from_volume, depth_scale_m);
#endif
    }
    if (first + LANES <= width && !may_change(mixture, first, y)) return;
    float4 factors[LANES];
    factors_of(mixture, first, y, factors);
    for (int x = first; x < end; x++) {
        const int pixel = y * width + x;
        const Mixed mixed = mixed_at(mixture, x, y, factors[x - first]);
#ifdef HAS_SHADOWS
        if (mixed.is_touched) {
            ratio_layer[3 * pixel] = ratio_code(mixed.factor.x);
            ratio_layer[3 * pixel + 1] = ratio_code(mixed.factor.y);
            ratio_layer[3 * pixel + 2] = ratio_code(mixed.factor.z);
        }
#endif
#ifdef HAS_OBJECTS
        if (mixed.part > 0.0f) {
            const float3 level = clamp(mixed.own, 0.0f, 1.0f) * 65535.0f + 0.5f;
            virtual_layer[pixel] = (uchar4)(codes[(int)level.x], codes[(int)level.y], codes[(int)level.z],
                                            (uchar)(255.0f * mixed.part + 0.5f));
            virtual_depth[pixel] = depth_at(virtual_positions, mixed.source, camera_from_volume, depth_scale_m);
        }
#endif
    }
}
