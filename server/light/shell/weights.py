"""The weights of the objective (objective.py), each with its unit and its reason. Logarithms are natural ones."""

from __future__ import annotations

import numpy as np

MEAN_ALBEDO, MEAN_SPREAD = 0.33, 0.3
"""Mean reflectance of a room's materials, with furniture and floors, and the standard deviation of its logit from
room to room: two thirds lie from .27 to .4."""
BRIGHTEST, BRIGHTEST_SPREAD = 0.6, 0.07
"""Albedo of a room's brightest white surface (BRIGHTEST_RANKS in level.py), and the standard deviation of its
logarithm: it sets the level of the light. In fifteen of sixteen rooms it differs by 9 %, the brightest of any colour by
12 %, mean albedo by 22 %. White paint is .8, but little of a room is as white."""
GIVEN_ALBEDO = 0.6
"""Albedo of all surface if it is constant."""
DISTANT_ALBEDO = 0.5
"""Mean albedo for the light from beyond the scan, whose direction is 2 degrees worse, and changes more with the volume,
where the level is found from the brightest surface. With the lobes' prior it is .99 of the true one in the mean of
mitsuba_room's sets, with .6 .84."""
ALBEDO_SPREAD = 0.5
"""Standard deviation of the logit of a material's albedo about the mean of the room's."""
MATERIAL_CHROMA = 0.8
"""Spacing of the grid of materials over log chroma: orange wood and white paint are a node apart. On a finer one, the
light's colour and the materials' go on exchanging."""
PATCH_NOISE = 0.13
"""Standard deviation of a patch's log radiance: transfer by rays, normals, what is not diffuse. With less, a clipped
speck beside the paint of a few patches is found to be a lamp."""
CONTACT_NOISE = 0.5
"""For the light from beyond the scan, the same besides for a patch that sees nothing but what is near it
(NEAR_SIDES in transport.py): what reaches it from there hangs on where the scan is to a part of a voxel. The variance
is a patch's share of such surface times as much: half a voxel's shift changes what that light brings to patches of the
real kitchen by .04 where nothing is near, by .14 where an eighth of the hemisphere is. The light by place has more to
tell at contacts: with this noise, chroma in one of four rooms errs by 11 % instead of 8."""
REGION_SPREAD = 0.05
"""Standard deviation of a region's log albedo about its surface's: stains, texture. More would take the gradients that
tell where light comes from for texture."""
SURFACE_SPREAD = 0.09
"""Standard deviation of a surface's log albedo about its material's (segments.py): more would take a wall in shade for
a dark one."""
DARK_EDGE, BRIGHT_EDGE = 0.03, 0.1
"""Log albedo below and above its material's from which the prior of a surface's grows linearly: paint may be black, and
a mug white among grey things, which have the same chroma. The real kitchen's white mug sends back .85 of the light that
is found; where the prior of bright surfaces is Gaussian, 1.07. The second is for the light by place: that from beyond
the scan, whose mean albedo is given, would turn by up to 10 degrees with the volume. With the tail of a Cauchy
distribution there are more minima, between which the light jumps."""
WHITE = 0.005
"""Deviation of a surface's log albedo above 0: nothing sends back more than it receives."""
ONE_ALBEDO = 0.01
"""Replaces the spreads if albedo is constant."""
LUMINOUS = 1.0
"""Excess of the log radiance over what white surface would show from which a patch is taken to be a light itself (a
window or a screen that is not clipped), and says nothing of the light that arrives."""
HUBER = 1.0
"""A patch whose residual exceeds so many standard deviations of the noise counts as an outlier."""
CELL_LOW, CELL_HIGH, CELL_HIDDEN = 0.47, 2.9, 0.7
"""Standard deviations of a cell's log radiance about the mean of what pictures show, since most of what they do not
show is surface like it: of the shell below the height of windows and lamps and above it (a lamp is 100 times as
bright), and of surface that was not seen. Of floor, about what it sends back of the light that arrives there. The
first two are of cells of shell.SIDE: a lamp fills more of smaller ones, and each pulls it to the mean."""
FLOOR_PATCHES = 10
"""The mean albedo of all patches counts as so many of floor in each grid where that of floor that was not scanned is
asked for: a fifth of a square metre."""
LOBE, LOBE_SHAPE = 0.4, 0.2
"""Most probable radiance of a distant lobe at the horizon, over the light's mean, as most of a sky is darker than its
mean; and shape of the gamma distribution of it. A bright lobe costs as its radiance, so that lobes which overlap share
a light in one way. With a normal distribution of the logarithm it costs least that one of them has it all, and there
are as many minima: a picture less turned the light of the real kitchen by 31 degrees."""
LOBE_UP = 0.5
"""By how much the logarithm of the most probable radiance grows with the sine of elevation, for light comes from above:
fitted to the medians of four environment maps it is .2, .6, .8 and 1.2, to the first band of ten published lights .5 to
3. Less than that, since with 1 lamps that stand beside a scan are found too high (docs/light_experiments.md)."""
LIT_EXCESS, LIT_SPREAD = 0.2, 1.0
"""For saturated surface that may be lit paint: mean radiance beyond what the picture shows, relative to that, and the
standard deviation of its log."""
LAMP_EXCESS, LAMP_SPREAD = 1.0, 2.0
"""The same for lamps and windows: a bulb is 200 times as bright as a picture shows it."""
SMOOTHNESS, EDGE = 1.3, 0.25
"""Weight of the squared difference of neighbouring cells' log radiance, and the difference from which it grows
linearly: the rims of lamps and windows are sharp. With twice that, the first pictures of a room tell less."""
CHROMA_NOISE = 0.06
"""Standard deviation of a patch's log chroma."""
SURFACE_CHROMA, REGION_CHROMA = 4.0, 0.03
"""Standard deviation of a surface's chroma of albedo: one orange floor says nothing of the light. Scale of the Cauchy
distribution of a region's about it: along one surface the cast changes with the light, but for paint and stains."""
WHITE_CHROMA, WHITE_CHROMA_SPREAD = np.array([0.05, -0.12]), 0.05
"""Chroma of albedo of a room's brightest surface, and its standard deviation: white paint (RAL 9010 has .05 and -.13).
In thirteen rooms the true one is .05 and -.12 in the mean and differs by .07 and .11, that of all surface by .17 and
.27, and the light's by .18 and .34."""
WHITE_TOLERANCE, NOT_WHITE = 0.2, 0.02
"""Deviation of chroma from white's by which surface counts less as white where the level is found, and how much that of
any chroma counts: it decides where nothing is white."""
CELL_CHROMA = 0.3
"""Standard deviation of a cell's chroma about the light's."""
TINT_AXIS = np.array([-0.46, 1.0]) / np.hypot(-0.46, 1.0)
"""[2] unit: along the colours of black bodies, from 4000 to 12000 K in linear sRGB. Lamps are warm, skies blue, and
neither is green."""
TINT, TINT_ACROSS = 0.45, 0.08
"""Standard deviations of the light's chroma about grey, along that axis and across it: in fifteen rooms the true one is
.44 and .09 from grey, root mean square."""
CHROMA_SMOOTHNESS = 5.0
"""Weight of the squared difference of neighbouring cells' chroma."""
