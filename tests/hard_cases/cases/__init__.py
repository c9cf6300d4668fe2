"""The catalogue: every family's cases."""

from __future__ import annotations

from tests.hard_cases.cases.camera import INPUT, TRACKING
from tests.hard_cases.cases.groups import GROUPS
from tests.hard_cases.cases.harmonics import HARMONICS
from tests.hard_cases.cases.kept_transfer import KEPT
from tests.hard_cases.cases.light_sums import LIGHT_SUMS
from tests.hard_cases.cases.rendering import RASTER, SHADOWS
from tests.hard_cases.cases.room_light import ROOM_LIGHT
from tests.hard_cases.cases.sessions import SESSIONS
from tests.hard_cases.cases.sums import SUMS
from tests.hard_cases.cases.surfaces import TRANSFER, VOLUME
from tests.hard_cases.catalogue import Case, Family

FAMILIES: tuple[Family, ...] = (
    LIGHT_SUMS,
    ROOM_LIGHT,
    SUMS,
    HARMONICS,
    TRANSFER,
    KEPT,
    VOLUME,
    TRACKING,
    INPUT,
    SHADOWS,
    RASTER,
    GROUPS,
    SESSIONS,
)
CASES: tuple[Case, ...] = tuple(case for family in FAMILIES for case in family.cases)
