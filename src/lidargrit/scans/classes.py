"""The one table of classes of points: SemanticKITTI's numbers with their names, and what other numberings mean by them.

Sources: Behley et al., SemanticKITTI, ICCV 2019, and the configuration published with it, for numbers, names and the 19
classes of its single-scan benchmark, in which what stands and what moves is one class; Xiao et al., PandaSet, ITSC
2021; Fong et al., Panoptic nuScenes, RA-L 2022. The colours are ours: what moves is warm, what stands is grey or brown,
and all can be seen on black and on white. The groups are ours, too: all data sets can be compared by them.
"""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from lidargrit.core.errors import ConfigError, one_of

CLASS_BITS: Final = 0xFFFF  # of a label: its class; the bits above number the instance

Colour = tuple[int, int, int]
Group = Literal["", "road", "sidewalk", "terrain", "building", "vegetation", "vehicle", "person, cycle", "pole, sign"]
"""What SemanticKITTI, PandaSet and nuScenes all tell apart; "" for classes by which they cannot be compared."""

CAR: Final = 10
BICYCLE: Final = 11
MOTORCYCLE: Final = 15
BUS: Final = 13
TRUCK: Final = 18
OTHER_VEHICLE: Final = 20
PERSON: Final = 30
BICYCLIST: Final = 31
MOTORCYCLIST: Final = 32
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
MOVING_BUS: Final = 257
MOVING_TRUCK: Final = 258

_CAR, _CYCLE, _LARGE, _PERSON = (74, 144, 226), (38, 183, 190), (118, 106, 232), (232, 64, 64)
_ROAD, _SIDEWALK, _GROUND, _TERRAIN = (176, 96, 176), (222, 76, 190), (146, 110, 146), (132, 160, 62)
_BUILDING, _FENCE, _STRUCTURE, _OBJECT = (224, 150, 40), (196, 120, 70), (180, 150, 100), (128, 138, 148)
_PLANT, _TRUNK, _POLE, _SIGN = (46, 158, 72), (140, 94, 50), (200, 180, 60), (240, 96, 30)


class SemanticClass(NamedTuple):
    """One class of SemanticKITTI.

    Args:
        colour: red, green and blue.
        learned: number of the benchmark's class that it belongs to, which networks learn; 0 for none.
        group: coarse class, by which several data sets are compared.
    """

    name: str
    colour: Colour
    learned: int
    group: Group


CLASSES: Final[dict[int, SemanticClass]] = {
    0: SemanticClass("not labelled", _OBJECT, 0, ""),
    1: SemanticClass("outlier", _OBJECT, 0, ""),
    CAR: SemanticClass("car", _CAR, CAR, "vehicle"),
    BICYCLE: SemanticClass("bicycle", _CYCLE, BICYCLE, "person, cycle"),
    BUS: SemanticClass("bus", _LARGE, OTHER_VEHICLE, "vehicle"),
    MOTORCYCLE: SemanticClass("motorcycle", _CYCLE, MOTORCYCLE, "person, cycle"),
    16: SemanticClass("rail vehicle", _LARGE, OTHER_VEHICLE, "vehicle"),
    TRUCK: SemanticClass("truck", _LARGE, TRUCK, "vehicle"),
    OTHER_VEHICLE: SemanticClass("other vehicle", _LARGE, OTHER_VEHICLE, "vehicle"),
    PERSON: SemanticClass("person", _PERSON, PERSON, "person, cycle"),
    BICYCLIST: SemanticClass("bicyclist", _PERSON, BICYCLIST, "person, cycle"),
    MOTORCYCLIST: SemanticClass("motorcyclist", _PERSON, MOTORCYCLIST, "person, cycle"),
    ROAD: SemanticClass("road", _ROAD, ROAD, "road"),
    PARKING: SemanticClass("parking", _SIDEWALK, PARKING, "road"),
    SIDEWALK: SemanticClass("sidewalk", _SIDEWALK, SIDEWALK, "sidewalk"),
    OTHER_GROUND: SemanticClass("other ground", _GROUND, OTHER_GROUND, ""),
    BUILDING: SemanticClass("building", _BUILDING, BUILDING, "building"),
    FENCE: SemanticClass("fence", _FENCE, FENCE, ""),
    OTHER_STRUCTURE: SemanticClass("other structure", _STRUCTURE, 0, ""),
    LANE_MARKING: SemanticClass("lane marking", _ROAD, ROAD, "road"),
    VEGETATION: SemanticClass("vegetation", _PLANT, VEGETATION, "vegetation"),
    TRUNK: SemanticClass("trunk", _TRUNK, TRUNK, "vegetation"),
    TERRAIN: SemanticClass("terrain", _TERRAIN, TERRAIN, "terrain"),
    POLE: SemanticClass("pole", _POLE, POLE, "pole, sign"),
    TRAFFIC_SIGN: SemanticClass("traffic sign", _SIGN, TRAFFIC_SIGN, "pole, sign"),
    OTHER_OBJECT: SemanticClass("other object", _OBJECT, 0, ""),
    MOVING_CAR: SemanticClass("moving car", _CAR, CAR, "vehicle"),
    MOVING_BICYCLIST: SemanticClass("moving bicyclist", _PERSON, BICYCLIST, "person, cycle"),
    MOVING_PERSON: SemanticClass("moving person", _PERSON, PERSON, "person, cycle"),
    255: SemanticClass("moving motorcyclist", _PERSON, MOTORCYCLIST, "person, cycle"),
    256: SemanticClass("moving rail vehicle", _LARGE, OTHER_VEHICLE, "vehicle"),
    MOVING_BUS: SemanticClass("moving bus", _LARGE, OTHER_VEHICLE, "vehicle"),
    MOVING_TRUCK: SemanticClass("moving truck", _LARGE, TRUCK, "vehicle"),
    259: SemanticClass("moving other vehicle", _LARGE, OTHER_VEHICLE, "vehicle"),
}

LEARNED: Final = tuple(sorted({each.learned for each in CLASSES.values()} - {0}))
"""The 19 numbers that networks learn and write, in the order of their channels."""

_PANDASET: Final = {  # PandaSet's classes.json → SemanticKITTI
    **dict.fromkeys((0, 1, 2, 3, 4, 32, 33), 0),  # nothing, smoke, exhaust, spray, reflections, animals
    5: VEGETATION,
    6: TERRAIN,
    7: ROAD,
    **dict.fromkeys((8, 9, 10), LANE_MARKING),
    11: SIDEWALK,
    12: PARKING,  # driveways
    **dict.fromkeys((13, 14), CAR),  # and pickups
    **dict.fromkeys((15, 16), TRUCK),
    **dict.fromkeys((17, 19, 20, 21, 22), OTHER_VEHICLE),  # towed, of builders, uncommon, pedicab, emergency
    **dict.fromkeys((18, 24, 25), MOTORCYCLE),  # and scooters, personal mobility
    23: 13,
    26: BICYCLE,
    **dict.fromkeys((27, 28, 29), 16),
    **dict.fromkeys((30, 31), PERSON),
    **dict.fromkeys((36, 38), TRAFFIC_SIGN),
    **dict.fromkeys((35, 39), FENCE),
    41: BUILDING,
    **dict.fromkeys((34, 37, 40, 42), OTHER_OBJECT),  # pylons, cones, containers; walls, fences and poles are one: 42
}
_NUSCENES: Final = {  # the ten classes to which nuScenes' range images are often merged → SemanticKITTI
    0: ROAD,
    1: SIDEWALK,
    2: BUILDING,
    3: OTHER_OBJECT,  # barriers and cones
    4: VEGETATION,  # and terrain
    5: PERSON,
    6: BICYCLE,
    7: CAR,
    8: TRUCK,
    9: 13,
    10: 0,
}
NUMBERINGS: Final[dict[str, dict[int, int]]] = {
    "semantic_kitti": {number: number for number in CLASSES},
    "pandaset": _PANDASET,
    "nuscenes": _NUSCENES,
}
"""What each number of a numbering is in SemanticKITTI's."""

_NAMED_AT_MOST = 8
_UNNAMED = (_CAR, _BUILDING, _PLANT, _PERSON, _ROAD, _CYCLE, _TERRAIN, _TRUNK, _LARGE, _POLE)


def names_and_colours(numbers: Sequence[int]) -> list[tuple[int, str, Colour]]:
    """Return each number with the name of its class, and its colour in red, green and blue.

    Numbers that are not all SemanticKITTI's are of another list, in which those that it has mean something else: none
    of them gets a name.
    """
    if all(number in CLASSES for number in numbers):
        return [(number, CLASSES[number].name, CLASSES[number].colour) for number in numbers]
    return [(number, f"class {number}", _UNNAMED[at % len(_UNNAMED)]) for at, number in enumerate(numbers)]


def unknown_numbers(label: Int[Tensor, "*B"], numbering: str = "semantic_kitti") -> list[int]:
    """Return the numbers of classes that a numbering does not have, ascending, of labels with or without instances."""
    return [number for number in (label.long() & CLASS_BITS).unique().tolist() if number not in NUMBERINGS[numbering]]


def listed(numbers: Sequence[int]) -> str:
    """Return numbers in words, the first eight of many."""
    return ", ".join(map(str, numbers[:_NAMED_AT_MOST])) + (", ..." if len(numbers) > _NAMED_AT_MOST else "")


def notes_on_labels(label: Int[Tensor, "n"] | None) -> tuple[str, ...]:
    """Return a note if some classes are none of SemanticKITTI's, so that the others are most likely none either."""
    if label is None or not (unknown := unknown_numbers(label)):
        return ()
    low, high = (int(number) for number in (label.long() & CLASS_BITS).aminmax())
    what = f"labels from {low} to {high} are not SemanticKITTI's, which has no {listed(unknown)}"
    return (f"{what}; map them to its numbers (learning_map_inv, if its learning_map made them)",)


def as_semantic_kitti(label: Int[Tensor, "*B"], numbering: str) -> Int[Tensor, "*B"]:
    """Return labels of a numbering by SemanticKITTI's numbers, without their instances.

    Args:
        label: labels, with or without instances in the bits above 16.
        numbering: one of :data:`NUMBERINGS`.

    Example:
        >>> as_semantic_kitti(torch.tensor([7, 13, 41]), "pandaset").tolist()
        [40, 10, 50]
    """
    if numbering not in NUMBERINGS:
        raise ConfigError(f"labels of the numbering {numbering!r}", one_of(sorted(NUMBERINGS)), "choose one")
    if unknown := unknown_numbers(label, numbering):
        fitting = [name for name in NUMBERINGS if not unknown_numbers(label, name)]
        got, cure = f"labels that {numbering} does not have: {listed(unknown)}", "map them to SemanticKITTI's numbers"
        raise ConfigError(got, "labels of " + (one_of(fitting) if fitting else one_of(sorted(NUMBERINGS))), cure)
    table = torch.zeros(max(NUMBERINGS[numbering]) + 1, dtype=torch.int64)
    for number, ours in NUMBERINGS[numbering].items():
        table[number] = ours
    return table.to(label.device)[label.long() & CLASS_BITS]
