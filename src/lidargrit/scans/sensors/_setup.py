"""Set-up of one unit of a sensor on its vehicle: what a simulator must know beside the directions of its rays."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Share

_OffsetM = Annotated[float, Bounds(-0.5, 0.5)]
_LogGain = Annotated[float, Bounds(-5, 5)]
_Factor = Annotated[float, Bounds(0.1, 10)]


@dataclass(frozen=True)
class SensorSetup(Settings):
    """Set-up of one unit of a sensor: noise, lasers, pulses, height above the road, and what its files leave out.

    ``offset_m``, ``log_gain`` and ``reading`` have one number for each row from the top, or none if all are alike.

    Args:
        range_sigma_m: standard deviation of the range noise close by, in metres.
        range_sigma_per_m: standard deviation that is added for each metre of range; the two add as squares.
        footprint_sigma: standard deviation as a share of the depth that a beam's footprint covers on a surface that
            it strikes at an angle; added as a square, too.
        offset_m: constant error of each laser's ranges, in metres.
        log_gain: natural logarithm of each laser's gain in power.
        reading: factor on the reflectance that each laser reports.
        firing_jitter_rad: standard deviation of the azimuth at which a laser fires, in radians. A firing that leaves
            its column leaves a pixel without a return, so narrow columns have gaps and wide ones have none.
        farthest_m: range in metres beyond which a data set keeps no return; 0 for the sensor's own limit.
        divergence_mrad: full angle of a beam in milliradians.
        pulse_length_m: distance in metres below which two echoes are heard as one.
        split_exponent: exponent of the share of a split beam that lies on the surface that is heard, by which its power
            is multiplied; at 0 each surface answers with its own part of the light alone.
        glass_passes: share of the light that goes through a pane, which depends on the wavelength.
        glass_scatters: factor on the light that panes scatter back, as their dust does: 1 for an HDL-64E, to which
            panes hardly ever return; some 40 for sensors from whose scans the windows of cars are not missing.
        reflectance_scale: factor on all reflectances: makers scale them as they like.
        reflectance_power: exponent of all reflectances before that factor: 1 for the units of the materials, in which
            KITTI's HDL-64E reads; above 1 for makers whose scale has more contrast.
        weak_dimming: share by which weak echoes read too dark: 1 as those of an HDL-64E, which fall to 0; 0 for none.
        fades_from_m: range from which reflectances read too dark, growing evenly until they read 0 at ``fades_to_m``.
        fades_to_m: range from which all reflectances read 0; 0 for sensors whose readings do not fade.
        height_m: height above the road, in metres.
    """

    range_sigma_m: Annotated[float, Bounds(0, 0.5)] = 0.01
    range_sigma_per_m: Annotated[float, Bounds(0, 0.05)] = 0.0
    footprint_sigma: Share = 0.0
    offset_m: Annotated[tuple[_OffsetM, ...], Bounds(0, 4096)] = ()
    log_gain: Annotated[tuple[_LogGain, ...], Bounds(0, 4096)] = ()
    reading: Annotated[tuple[_Factor, ...], Bounds(0, 4096)] = ()
    firing_jitter_rad: Annotated[float, Bounds(0, 0.1)] = 0.0
    farthest_m: Annotated[float, Bounds(0, 1000)] = 0.0
    divergence_mrad: Annotated[float, Bounds(0, 50)] = 2.0
    pulse_length_m: Annotated[float, Bounds(above=0, most=10)] = 0.75
    split_exponent: Annotated[float, Bounds(0, 64)] = 0.0
    glass_passes: Share = 0.2
    glass_scatters: Annotated[float, Bounds(0, 1000)] = 1.0
    reflectance_scale: Annotated[float, Bounds(0.01, 10)] = 1.0
    reflectance_power: Annotated[float, Bounds(0.5, 4)] = 1.0
    weak_dimming: Share = 1.0
    fades_from_m: Annotated[float, Bounds(0, 1000)] = 0.0
    fades_to_m: Annotated[float, Bounds(0, 1000)] = 0.0
    height_m: Annotated[float, Bounds(0.1, 10)] = 1.73

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.fades_to_m <= self.fades_from_m:
            got = f"fades_from_m={self.fades_from_m:g}, fades_to_m={self.fades_to_m:g}"
            raise ConfigError(got, "a range that is farther to fade to", "give one, or 0 for readings that do not fade")

    def check_rows(self, name: str, height: int) -> None:
        """Refuse lists of lasers that are not as long as a sensor has rows."""
        for what in ("offset_m", "log_gain", "reading"):
            if len(values := getattr(self, what)) not in (0, height):
                got = f"{len(values)} values of {what} in the set-up of the sensor {name!r}"
                raise ConfigError(got, f"one for each of its {height} rows, or none", "give as many, or leave them out")

    @classmethod
    def sample(cls, rng: np.random.Generator, height: int) -> "SensorSetup":
        """Sample the set-up of a unit of which there are no scans.

        The bounds hold what six sensors show of which there are: noise of 4 to 20 mm, offsets up to those of KITTI's
        HDL-64E, heights of 1.6 to 2.2 m, and reflectances from the scale of a Pandar64 to that of KITTI.

        Args:
            height: number of rows.
        """
        bits = rng.bit_generator
        assert isinstance(bits, np.random.PCG64)
        aside = np.random.Generator(bits.jumped())  # so that what is drawn next from rng stays what it was
        gain_spread, offset_spread_m = rng.uniform(0, 0.31), rng.uniform(0, 0.025)
        return cls(
            range_sigma_m=float(rng.uniform(0.004, 0.02)),
            range_sigma_per_m=float(rng.uniform(0, 0.0006)),
            footprint_sigma=float(rng.uniform(0, 0.06)),
            offset_m=tuple(np.clip(offset_spread_m * rng.standard_normal(height), -0.1, 0.1).tolist()),
            log_gain=tuple(np.clip(gain_spread * rng.standard_normal(height), -2, 2).tolist()),
            firing_jitter_rad=float(rng.uniform(0, 0.00072)),
            divergence_mrad=float(rng.uniform(1, 3)),
            pulse_length_m=float(rng.uniform(0.5, 1)),
            split_exponent=float(rng.uniform(0, 12)),
            glass_passes=float(rng.uniform(0.1, 0.3)),
            reflectance_scale=float(np.exp(rng.uniform(np.log(0.2), 0))),
            height_m=float(rng.uniform(1.6, 2.2)),
            weak_dimming=float(rng.uniform(0, 1)),
            glass_scatters=float(np.exp(aside.uniform(0, np.log(40)))),
        )
