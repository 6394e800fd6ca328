"""Names and colours of labels: SemanticKITTI's number → name and colour.

Source: the numbers and names are those of Behley et al., SemanticKITTI, ICCV 2019, and the configuration published with
it. The colours are ours: what moves is warm, what stands is grey or brown, and all can be seen on black and on white.
"""

from collections.abc import Sequence

Colour = tuple[int, int, int]

_CAR, _CYCLE, _LARGE, _PERSON = (74, 144, 226), (38, 183, 190), (118, 106, 232), (232, 64, 64)
_ROAD, _PAVEMENT, _GROUND, _TERRAIN = (176, 96, 176), (222, 76, 190), (146, 110, 146), (132, 160, 62)
_BUILDING, _FENCE, _STRUCTURE, _OBJECT = (224, 150, 40), (196, 120, 70), (180, 150, 100), (128, 138, 148)
_PLANT, _TRUNK, _POLE, _SIGN = (46, 158, 72), (140, 94, 50), (200, 180, 60), (240, 96, 30)

CLASSES: dict[int, tuple[str, Colour]] = {
    0: ("not labelled", _OBJECT),
    1: ("outlier", _OBJECT),
    10: ("car", _CAR),
    11: ("bicycle", _CYCLE),
    13: ("bus", _LARGE),
    15: ("motorcycle", _CYCLE),
    16: ("rail vehicle", _LARGE),
    18: ("truck", _LARGE),
    20: ("other vehicle", _LARGE),
    30: ("person", _PERSON),
    31: ("cyclist", _PERSON),
    32: ("motorcyclist", _PERSON),
    40: ("road", _ROAD),
    44: ("parking", _PAVEMENT),
    48: ("pavement", _PAVEMENT),
    49: ("other ground", _GROUND),
    50: ("building", _BUILDING),
    51: ("fence", _FENCE),
    52: ("other structure", _STRUCTURE),
    60: ("lane marking", _ROAD),
    70: ("vegetation", _PLANT),
    71: ("trunk", _TRUNK),
    72: ("terrain", _TERRAIN),
    80: ("pole", _POLE),
    81: ("traffic sign", _SIGN),
    99: ("other object", _OBJECT),
    252: ("moving car", _CAR),
    253: ("moving cyclist", _PERSON),
    254: ("moving person", _PERSON),
    255: ("moving motorcyclist", _PERSON),
    256: ("moving rail vehicle", _LARGE),
    257: ("moving bus", _LARGE),
    258: ("moving truck", _LARGE),
    259: ("moving other vehicle", _LARGE),
}


_UNNAMED = (_CAR, _BUILDING, _PLANT, _PERSON, _ROAD, _CYCLE, _TERRAIN, _TRUNK, _LARGE, _POLE)


def names_and_colours(numbers: Sequence[int]) -> list[tuple[int, str, Colour]]:
    """Return each number with the name of its class, and its colour in red, green and blue.

    Numbers that are not all SemanticKITTI's are of another list, in which those that it has mean something else: none
    of them gets a name.
    """
    if all(number in CLASSES for number in numbers):
        return [(number, *CLASSES[number]) for number in numbers]
    return [(number, f"class {number}", _UNNAMED[at % len(_UNNAMED)]) for at, number in enumerate(numbers)]
