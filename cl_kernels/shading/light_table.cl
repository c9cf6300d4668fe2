// The table of a light (include/light_table.clh). Provides tabulate_arriving.
#ifndef BANDS
#error BANDS must be defined: the number of spherical-harmonics bands
#endif
#include "light_table.clh"

// Radiance, clamped to 0, along directions [of.directions] of all sets, from each place: table's coefficients -> its arriving.
kernel void tabulate_arriving(const LightTable of, global uchar *table, global const float4 *directions) {
    const int direction = get_global_id(0);
    const int place = get_global_id(1);
    if (direction >= of.directions || place >= of.places) return;
    global const float4 *coefficients = coefficients_of(of, table, place);
    float y[COEFFICIENTS];
    sh_basis(directions[direction].xyz, y);
    float3 radiance = (float3)(0.0f);
    for (int k = 0; k < COEFFICIENTS; k++) radiance += y[k] * coefficients[k].xyz;
    ((global float4 *)(table + of.arriving_at))[place * of.directions + direction] = (float4)(fmax(radiance, 0.0f), 0.0f);
}
