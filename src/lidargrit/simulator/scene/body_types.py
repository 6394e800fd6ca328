"""Body types of vehicles: the profiles from which their shapes are lofted."""

from dataclasses import dataclass

from lidargrit.scans import classes

_CAR_PLAN = ((0.0, 0.66), (0.025, 0.83), (0.08, 0.94), (0.2, 0.99), (0.35, 1.0), (0.8, 1.0), (0.92, 0.96),
             (0.975, 0.89), (1.0, 0.76))  # fmt: skip
_BOX_PLAN = ((0.0, 0.80), (0.015, 0.92), (0.05, 0.98), (0.12, 1.0), (0.97, 1.0), (0.99, 0.98), (1.0, 0.95))


@dataclass(frozen=True)
class BodyType:
    """Profiles of one body type, by shares of its length behind the nose.

    Args:
        size_m: length, width and height: middle of the class, after data sheets of common vehicles, in round numbers.
        spread: relative spread of these.
        top: share of the height of bonnet, screens and roof.
        belt: share of the height at which the side windows begin, at the nose and at the tail.
        tumble: lean of the side above the belt, in metres inwards for each metre upwards.
        windscreen: interval in which the top is a windscreen.
        rear_screen: interval in which the top is a rear window; an empty one for none.
        windows: intervals of the side windows; pillars stand between them.
        seats: backs of the rows of seats.
        axles: middles of the wheels.
        wheel_m: radius of the wheels.
        clearance_m: height of the sill.
        plan: share of half the width, from above.
        label: class of those that stand.
        moving: class of those that drive.
    """

    size_m: tuple[float, float, float]
    spread: tuple[float, float, float]
    top: tuple[tuple[float, float], ...]
    belt: tuple[float, float]
    tumble: float
    windscreen: tuple[float, float]
    rear_screen: tuple[float, float]
    windows: tuple[tuple[float, float], ...]
    seats: tuple[float, ...]
    axles: tuple[float, ...]
    wheel_m: float = 0.315
    clearance_m: float = 0.19
    plan: tuple[tuple[float, float], ...] = _CAR_PLAN
    label: int = classes.CAR
    moving: int = classes.MOVING_CAR


_HATCHBACK = BodyType(
    size_m=(4.1, 1.76, 1.48),
    spread=(0.05, 0.02, 0.025),
    top=((0.0, 0.36), (0.012, 0.47), (0.05, 0.56), (0.12, 0.62), (0.2, 0.655), (0.255, 0.68), (0.42, 0.945),
         (0.5, 0.99), (0.58, 1.0), (0.75, 0.975), (0.86, 0.93), (0.945, 0.68), (0.975, 0.58), (0.995, 0.48),
    (1.0, 0.40)), belt=(0.625, 0.68),
    tumble=0.42,
    windscreen=(0.262, 0.415),
    rear_screen=(0.87, 0.94),
    windows=((0.375, 0.545), (0.565, 0.72), (0.745, 0.82)),
    seats=(0.53, 0.75),
    axles=(0.195, 0.815),
)  # fmt: skip
_SMALL = BodyType(
    size_m=(3.6, 1.65, 1.49),
    spread=(0.04, 0.015, 0.025),
    top=((0.0, 0.38), (0.012, 0.50), (0.05, 0.59), (0.11, 0.645), (0.17, 0.67), (0.22, 0.695), (0.40, 0.95), (0.5, 1.0),
         (0.75, 0.99), (0.90, 0.94), (0.96, 0.70), (0.98, 0.58), (0.995, 0.48), (1.0, 0.40)),
    belt=(0.63, 0.68),
    tumble=0.40,
    windscreen=(0.228, 0.395),
    rear_screen=(0.905, 0.955),
    windows=((0.36, 0.565), (0.59, 0.76)),
    seats=(0.54, 0.78),
    axles=(0.175, 0.84),
    wheel_m=0.29,
)  # fmt: skip
_SALOON = BodyType(
    size_m=(4.68, 1.81, 1.45),
    spread=(0.05, 0.02, 0.02),
    top=((0.0, 0.36), (0.012, 0.47), (0.05, 0.57), (0.13, 0.64), (0.22, 0.67), (0.275, 0.69), (0.43, 0.95), (0.51, 1.0),
         (0.62, 0.985), (0.69, 0.95), (0.825, 0.725), (0.9, 0.72), (0.965, 0.705), (0.985, 0.6), (1.0, 0.42)),
    belt=(0.64, 0.69),
    tumble=0.44,
    windscreen=(0.282, 0.425),
    rear_screen=(0.70, 0.82),
    windows=((0.385, 0.535), (0.555, 0.69)),
    seats=(0.52, 0.70),
    axles=(0.19, 0.79),
)  # fmt: skip
_ESTATE = BodyType(
    size_m=(4.65, 1.81, 1.49),
    spread=(0.05, 0.02, 0.025),
    top=((0.0, 0.36), (0.012, 0.47), (0.05, 0.56), (0.12, 0.625), (0.2, 0.655), (0.26, 0.68), (0.41, 0.945),
         (0.49, 1.0), (0.7, 1.0), (0.88, 0.955), (0.915, 0.93), (0.965, 0.68), (0.98, 0.58), (1.0, 0.42)),
    belt=(0.625, 0.67),
    tumble=0.40,
    windscreen=(0.266, 0.405),
    rear_screen=(0.918, 0.962),
    windows=((0.36, 0.51), (0.53, 0.67), (0.695, 0.85)),
    seats=(0.5, 0.68),
    axles=(0.19, 0.79),
)  # fmt: skip
_SUV = BodyType(
    size_m=(4.45, 1.85, 1.67),
    spread=(0.05, 0.02, 0.03),
    top=((0.0, 0.40), (0.012, 0.53), (0.05, 0.61), (0.13, 0.655), (0.2, 0.675), (0.245, 0.69), (0.375, 0.94),
         (0.46, 1.0), (0.75, 0.99), (0.885, 0.95), (0.945, 0.70), (0.975, 0.60), (0.995, 0.5), (1.0, 0.42)),
    belt=(0.64, 0.68),
    tumble=0.34,
    windscreen=(0.252, 0.37),
    rear_screen=(0.892, 0.94),
    windows=((0.335, 0.50), (0.52, 0.68), (0.705, 0.83)),
    seats=(0.49, 0.69),
    axles=(0.19, 0.79),
    wheel_m=0.355,
    clearance_m=0.26,
)  # fmt: skip
_MINIVAN = BodyType(
    size_m=(4.5, 1.82, 1.68),
    spread=(0.06, 0.02, 0.04),
    top=((0.0, 0.34), (0.012, 0.46), (0.04, 0.53), (0.1, 0.58), (0.155, 0.61), (0.20, 0.65), (0.37, 0.93), (0.46, 0.99),
         (0.6, 1.0), (0.86, 0.975), (0.93, 0.94), (0.97, 0.66), (0.985, 0.55), (1.0, 0.38)),
    belt=(0.575, 0.62),
    tumble=0.32,
    windscreen=(0.185, 0.365),
    rear_screen=(0.935, 0.968),
    windows=((0.26, 0.305), (0.325, 0.49), (0.51, 0.67), (0.695, 0.88)),
    seats=(0.46, 0.66),
    axles=(0.185, 0.81),
    wheel_m=0.325,
)  # fmt: skip
_PEOPLE_VAN = BodyType(
    size_m=(4.95, 1.93, 1.95),
    spread=(0.05, 0.02, 0.03),
    top=((0.0, 0.30), (0.012, 0.40), (0.04, 0.46), (0.1, 0.51), (0.15, 0.545), (0.185, 0.58), (0.30, 0.92),
         (0.36, 0.98), (0.45, 1.0), (0.93, 0.985), (0.965, 0.95), (0.985, 0.55), (0.995, 0.42), (1.0, 0.30)),
    belt=(0.55, 0.555),
    tumble=0.17,
    windscreen=(0.19, 0.295),
    rear_screen=(0.966, 0.984),
    windows=((0.255, 0.39), (0.415, 0.64), (0.665, 0.91)),
    seats=(0.38, 0.62),
    axles=(0.18, 0.80),
    wheel_m=0.335,
)  # fmt: skip
_PANEL_VAN = BodyType(
    size_m=(5.6, 2.0, 2.35),
    spread=(0.08, 0.02, 0.08),
    top=((0.0, 0.26), (0.01, 0.36), (0.035, 0.41), (0.09, 0.455), (0.125, 0.48), (0.15, 0.50), (0.255, 0.86),
         (0.30, 0.95), (0.36, 1.0), (0.96, 1.0), (0.985, 0.98), (0.995, 0.6), (1.0, 0.24)),
    belt=(0.475, 0.475),
    tumble=0.12,
    windscreen=(0.154, 0.25),
    rear_screen=(0.95, 0.95),
    windows=((0.215, 0.335),),
    seats=(0.33,),
    axles=(0.165, 0.78),
    wheel_m=0.345,
    clearance_m=0.22,
    plan=_BOX_PLAN,
)  # fmt: skip
_LORRY = BodyType(
    size_m=(8.4, 2.48, 3.3),
    spread=(0.12, 0.015, 0.06),
    top=((0.0, 0.20), (0.002, 0.30), (0.005, 0.40), (0.012, 0.47), (0.04, 0.76), (0.065, 0.80), (0.12, 0.81),
         (0.235, 0.81), (0.245, 0.80), (0.25, 0.345), (0.26, 0.33), (1.0, 0.33)),
    belt=(0.46, 0.46),
    tumble=0.06,
    windscreen=(0.0125, 0.0385),
    rear_screen=(0.95, 0.95),
    windows=((0.055, 0.15),),
    seats=(0.16,),
    axles=(0.145, 0.74, 0.88),
    wheel_m=0.49,
    clearance_m=0.45,
    plan=((0.0, 0.86), (0.01, 0.95), (0.03, 1.0), (0.24, 1.0), (0.25, 0.98), (0.27, 0.9), (1.0, 0.9)),
    label=classes.TRUCK,
    moving=classes.MOVING_TRUCK,
)  # fmt: skip
_BUS = BodyType(
    size_m=(12.0, 2.55, 3.05),
    spread=(0.03, 0.0, 0.02),
    top=((0.0, 0.18), (0.002, 0.28), (0.006, 0.33), (0.018, 0.90), (0.026, 0.96), (0.04, 1.0), (0.97, 1.0),
         (0.985, 0.97), (0.995, 0.5), (1.0, 0.2)),
    belt=(0.42, 0.42),
    tumble=0.06,
    windscreen=(0.0065, 0.0175),
    rear_screen=(0.95, 0.95),
    windows=((0.025, 0.08), (0.092, 0.20), (0.21, 0.32), (0.33, 0.44), (0.45, 0.56), (0.57, 0.68), (0.69, 0.80),
             (0.81, 0.93)),
    seats=(0.25, 0.33, 0.48, 0.6, 0.75, 0.85),
    axles=(0.22, 0.72),
    wheel_m=0.48,
    clearance_m=0.32,
    plan=((0.0, 0.9), (0.006, 0.97), (0.02, 1.0), (0.98, 1.0), (0.992, 0.98), (1.0, 0.93)),
    label=classes.BUS,
    moving=classes.MOVING_BUS,
)  # fmt: skip

BODY_TYPES = (_HATCHBACK, _SMALL, _SALOON, _ESTATE, _SUV, _MINIVAN, _PEOPLE_VAN, _PANEL_VAN, _LORRY, _BUS)
HATCHBACK, SMALL, SALOON, ESTATE, SUV, MINIVAN, PEOPLE_VAN, PANEL_VAN, LORRY, BUS = range(10)
SHARES = (0.27, 0.12, 0.17, 0.17, 0.1, 0.07, 0.04, 0.06, 0.0, 0.0)  # of those that are neither lorry nor bus
