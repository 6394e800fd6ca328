"""Classes of objects: a name → its number in SemanticKITTI.

Source: Behley et al., SemanticKITTI, ICCV 2019, and the configuration published with it.
"""

from typing import Final

CAR: Final = 10
BICYCLE: Final = 11
MOTORCYCLE: Final = 15
TRUCK: Final = 18
OTHER_VEHICLE: Final = 20
PERSON: Final = 30
BICYCLIST: Final = 31
ROAD: Final = 40
PARKING: Final = 44
SIDEWALK: Final = 48
OTHER_GROUND: Final = 49
BUILDING: Final = 50
FENCE: Final = 51
OTHER_STRUCTURE: Final = 52
LANE_MARKING: Final = 60
VEGETATION: Final = 70
TRUNK: Final = 71
TERRAIN: Final = 72
POLE: Final = 80
TRAFFIC_SIGN: Final = 81
OTHER_OBJECT: Final = 99
MOVING_CAR: Final = 252
MOVING_BICYCLIST: Final = 253
MOVING_PERSON: Final = 254
MOVING_TRUCK: Final = 258

LABELS: Final = frozenset(
    number for name, number in list(globals().items()) if name.isupper() and isinstance(number, int)
)
