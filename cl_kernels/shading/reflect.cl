// Glossy virtual surface (thesis fig. 8.4): its reflection of the light, of real and of other virtual surface.
// Provides reflect_surroundings.
#include "sh.clh"
#include "shadows.clh"

#define RAYS 8
#define GOLDEN 2.399963f  // radians: turns that never meet again

// Radiance of the light from a direction, seen through a lobe `spread` radians wide (a heat kernel: exp(-l (l + 1) s^2 / 2)).
static float3 blurred_light(global const float4 *light, const float3 direction, const float spread) {
    float y[COEFFICIENTS];
    sh_basis(direction, y);
    float3 sum = (float3)(0.0f);
    for (int l = 0; l < BANDS; l++) {
        const float kept = exp(-0.5f * l * (l + 1) * spread * spread);
        for (int i = l * l; i < (l + 1) * (l + 1); i++) sum += kept * y[i] * light[i].xyz;
    }
    return fmax(sum, (float3)(0.0f));
}

// Fraction of uniform light that microfacets reflect, as a + b F0: Karis' fit (2014) to the integral of GGX over directions.
static inline float2 reflected_share(const float roughness, const float cosine) {
    const float4 r = roughness * (float4)(-1.0f, -0.0275f, -0.572f, 0.022f) + (float4)(1.0f, 0.0425f, 1.04f, -0.04f);
    const float a = fmin(r.x * r.x, exp2(-9.28f * cosine)) * r.x + r.y;
    return (float2)(1.04f * a + r.w, -1.04f * a + r.z);
}

// Mean radiance from RAYS directions around `mirrored`, `spread` radians wide.
static float3 mean_arriving(const Volume volume, const Objects things, const Arriving light, global const float4 *coefficients,
                            const float3 position, const float3 normal, const float3 mirrored, const float spread, const float turn) {
    const float3 side = normalize(cross(mirrored, fabs(mirrored.x) < 0.7f ? (float3)(1, 0, 0) : (float3)(0, 1, 0)));
    const float3 other = cross(mirrored, side);
    const float3 origin = clear_origin(volume, position, normal);
    float3 sum = (float3)(0.0f);
    float weight = 0.0f;
    for (int k = 0; k < RAYS; k++) {
        const float radius = tan(fmin(spread, 1.0f)) * sqrt((k + 0.5f) / RAYS), angle = GOLDEN * k + turn;
        const float3 direction = normalize(mirrored + radius * (cos(angle) * side + sin(angle) * other));
        if (dot(direction, normal) <= 0.0f) continue;
        weight += 1.0f;
        float3 sent;
        float met_m;
        if (object_between(things, light, position + things.offset_m * normal, direction, &met_m, &sent)) {
            sum += sent;
            continue;
        }
        const Vectors ray = {(floatn)(direction.x), (floatn)(direction.y), (floatn)(direction.z)};
        const Rays rays = make_rays(origin / volume.voxel_m, ray);
        floatn begin, end;
        clip_rays(volume, rays, &begin, &end);
        end = fmin(end, light.ray_length_m / volume.voxel_m);
        float first[LANES], last[LANES];
        STORE_LANES(find_solid_voxels(volume, rays, begin, end), first);
        STORE_LANES(end, last);
        if (first[0] < last[0])
            sum += sent_from(volume, light, origin, direction, first[0], 1);
        else
            sum += blurred_light(coefficients, direction, 0.5f * spread);
    }
    return weight > 0.0f ? sum / weight : (float3)(0.0f);
}

// positions, normals, base_colors, materials [h][w] (w = 1 where covered): the virtual geometry buffer, materials: roughness, metalness.
// The scene's samples are the pixels.
// -> reflected [h][w]: radiance to add (rgb) and factor of the diffuse one (w); (0, 0, 0, 1) for matt surface.
kernel void reflect_surroundings(const ReflectionParameters parameters, SCENE_BUFFERS, global const float4 *positions,
                                 global const float4 *normals, global const float4 *base_colors, global const float4 *materials,
                                 global const int *shown, global float4 *reflected) {
    const int x = get_global_id(0);
    const int y = get_global_id(1);
    const SceneParameters scene = parameters.scene;
    if (x >= scene.samples.cols || y >= scene.samples.rows) return;
    const int pixel = y * scene.samples.width + x;
    const float4 position = positions[pixel], material = materials[pixel];
    float4 result = (float4)(0.0f, 0.0f, 0.0f, 1.0f);
    if (position.w > 0.0f && fmax(1.0f - material.x, material.y) >= parameters.least_gloss) {
        const Volume volume = VOLUME_OF_SCENE;
        const Objects things = OBJECTS_OF_SCENE(own_offset_m(scene.objects.count, grids_of(object_table), shown[pixel]));
        const int place = place_of_object(scene.light.table, light_table, shown[pixel]);
        const Arriving arrives = ARRIVING_OF_SCENE(place);
        const float3 normal = normals[pixel].xyz, back = normalize(parameters.eye.xyz - position.xyz);
        const float cosine = clamp(dot(normal, back), 0.0f, 1.0f), metal = clamp(material.y, 0.0f, 1.0f);
        const float3 head_on = (1.0f - metal) * (float3)(0.04f) + metal * base_colors[pixel].xyz;
        const float2 share = reflected_share(material.x, cosine);
        // The fit lacks multiple scattering between microfacets; compensated as in Turquin (2019).
        const float3 gloss = clamp((share.x + share.y * head_on) * (1.0f + head_on * (1.0f / (share.x + share.y) - 1.0f)), 0.0f, 1.0f);
        const float turn = GOLDEN * ((y & 3) * 4 + (x & 3));
        const float3 arriving = mean_arriving(volume, things, arrives, whole_light_of(scene.light.table, light_table, place), position.xyz, normal,
        2.0f * dot(normal, back) * normal - back,
                                              material.x * material.x, turn);
        const float dielectric = clamp(share.x + 0.04f * share.y, 0.0f, 1.0f);
        result = (float4)(gloss * arriving, (1.0f - metal) * (1.0f - dielectric));
    }
    reflected[pixel] = result;
}
