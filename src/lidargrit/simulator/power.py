"""Received power of a beam: surfaces, incidence and range → power, probability of a return, and reflectance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from scipy.special import ndtr

from lidargrit.core.errors import ConfigError
from lidargrit.scans.sensors import SensorSetup
from lidargrit.simulator.materials import ASPHALT, CONCRETE, GLASS, MATERIALS, Material
from lidargrit.simulator.mesh import Finish

_PATCH_AT_LEAST_DEG = 0.01  # finer than any sensor's columns; every patch of a ring takes memory
_INCIDENCE_AT_LEAST = 0.05  # cosine: beyond 87 degrees a beam's footprint ends with the surface


@dataclass(frozen=True)
class RaydropModel:
    """Parameters of which beams return and what is measured, alike for all sensors; the defaults suit KITTI's HDL-64E.

    What differs from unit to unit is in :class:`.SensorSetup`.

    Powers are in units of what a white plate at 1 m would send back, were the receiver in focus there. "Fitted" numbers
    bring simulated scans nearest to 67 scans of KITTI, all together: ``benchmarks/fit_raydrop.py`` finds them, and
    ``docs/results/simulator-against-kitti.md`` says how near that is. Single ones of them are not measurements.

    Args:
        least_power: weakest power that is detected. Set by hand: asphalt is lost at about 55 m, as in KITTI. The fit
            does not move it, since albedos and gains do the same.
        near_m: range below which the receiver is out of focus, so that power stops growing as 1 / range^2. Fitted.
        extinction_per_m: share of light that air takes per metre, one way. 0 is clear air; fog of 500 m visibility has
            about 0.006, by Koschmieder's rule, 3 / visibility.
        gloss: factor on the gloss of all materials.
        retroreflection: factor on the retroreflection of all materials.
        patch_spread: spread of the log gain along a ring. Fitted.
        patch_deg: angle along a ring over which that gain is correlated. Fitted.
        object_spread: spread of the log gain from object to object. Fitted.
        pulse_spread: spread of the log gain from pulse to pulse. Fitted.
        edge_share: relative bend of inverse range above which a pixel counts as an edge; a plane has no bend.
        dim_level: log of power over ``least_power`` below which reflectance reads 0. Set by hand.
        dim_share: share of its reflectance that an echo just above that level reads; KITTI has few readings in
            (0, 0.05). Fitted.
        bright_level: log of power over ``least_power`` above which reflectance reads in full. Set by hand.
        reflectance_spread: relative spread of reflectance from pulse to pulse, besides its material's. Set by hand:
            with it neighbouring readings of near ground differ as in KITTI, by 0.12.
        wet_darkening: share of scattered light that soaked asphalt or concrete loses. Assumed: about half, because
            films of water darken rough ground.
        wet_gloss: strength of the mirror-like lobe of soaked ground. Assumed: 0.02, as Fresnel's law has it for water.
        materials: reflection properties of all materials.
    """

    least_power: float = 2.5e-6
    near_m: float = 12.3
    extinction_per_m: float = 0.0
    gloss: float = 1.0
    retroreflection: float = 1.0
    patch_spread: float = 0.141
    patch_deg: float = 4.82
    object_spread: float = 0.522
    pulse_spread: float = 0.424
    edge_share: float = 0.05
    dim_level: float = 2.6
    dim_share: float = 0.175
    bright_level: float = 3.4
    reflectance_spread: float = 0.08
    wet_darkening: float = 0.5
    wet_gloss: float = 0.02
    materials: tuple[Material, ...] = MATERIALS

    def __post_init__(self) -> None:
        if not self.least_power > 0:  # also for NaN
            raise ConfigError(f"least_power={self.least_power:g}", "a power above 0", "correct the raydrop model")
        if not self.patch_deg >= _PATCH_AT_LEAST_DEG:
            wanted = f"{_PATCH_AT_LEAST_DEG:g} or more"
            raise ConfigError(f"patch_deg={self.patch_deg:g}", wanted, "correct the raydrop model")


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Reflection properties of every triangle of a scene; the last entry is for rays that hit nothing.

    Args:
        albedo: share of light scattered evenly.
        material: index into the tables below.
        gloss: strength of each material's mirror-like lobe.
        lobe_power: exponent of each material's mirror-like lobe.
        retroreflection: strength of the lobe that each material sends straight back.
        passes: share of light that passes each material.
        mottle: relative variation of each material's reflectance from spot to spot.
    """

    albedo: Float32[np.ndarray, " t"]
    material: UInt8[np.ndarray, " t"]
    gloss: Float32[np.ndarray, " m"]
    lobe_power: Float32[np.ndarray, " m"]
    retroreflection: Float32[np.ndarray, " m"]
    passes: Float32[np.ndarray, " m"]
    mottle: Float32[np.ndarray, " m"]

    @classmethod
    def of(cls, finish: Finish, model: RaydropModel, setup: SensorSetup, wet: float = 0.0) -> "Surfaces":
        """Look up the materials of a mesh, on ground between dry (``wet`` 0) and soaked (1)."""
        albedo = np.append(finish.albedo, np.float32(0))
        material = np.append(finish.material, np.uint8(len(model.materials)))
        nothing = Material("nothing")
        diffuse, gloss, lobe_power, retro, passes, mottle = (
            np.array([getattr(m, name) for m in (*model.materials, nothing)], np.float32)
            for name in ("diffuse", "gloss", "lobe_power", "retroreflection", "passes", "mottle")
        )
        albedo *= diffuse[material]
        gloss, retro = gloss * np.float32(model.gloss), retro * np.float32(model.retroreflection)
        if wet:
            albedo[(material == ASPHALT) | (material == CONCRETE)] *= np.float32(1 - wet * model.wet_darkening)
            gloss[[ASPHALT, CONCRETE]] = wet * model.wet_gloss
            lobe_power[[ASPHALT, CONCRETE]] = 100  # a film on rough ground: a narrow lobe, a third at 8 degrees
        passes[GLASS] = setup.glass_passes
        albedo[material == GLASS] *= np.float32(setup.glass_scatters)
        mottle = np.hypot(mottle, np.float32(model.reflectance_spread))
        return cls(albedo, material, gloss, lobe_power, retro, passes, mottle)

    def passing(self) -> Float32[np.ndarray, " t"]:
        """Return the share of light that goes through each triangle."""
        return self.passes[self.material]

    def specular(
        self, triangle: Int32[np.ndarray, " n"], cos_incidence: Float32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Return what surfaces send back besides the light they scatter evenly: gloss and retroreflection."""
        material = self.material[triangle]
        specular = np.zeros(len(triangle), np.float32)
        bright = np.flatnonzero(((self.gloss > 0) | (self.retroreflection > 0))[material])
        of, cos = material[bright], cos_incidence[bright]
        specular[bright] = self.gloss[of] * cos ** self.lobe_power[of] + self.retroreflection[of] * cos
        return specular

    def brightness(
        self, triangle: Int32[np.ndarray, " n"], cos_incidence: Float32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Return the brightness of surfaces: Lambert's law, a mirror-like lobe, and retroreflection.

        A foil sends light back whatever the incidence; only the area that it turns to the beam shrinks.
        """
        return self.albedo[triangle] * cos_incidence + self.specular(triangle, cos_incidence)


def received_power(
    brightness: Float32[np.ndarray, "*shape"], range_m: Float32[np.ndarray, "*shape"], model: RaydropModel
) -> Float32[np.ndarray, "*shape"]:
    """Return the power that comes back from surfaces that fill the beam; 0 from infinity.

    The overlap of beam and receiver, which HDL-64E lacks close by, is written as a constant added to range^2.

    Source:
        Wagner et al., ISPRS J. 60(2), 2006, eq. 4 (the lidar equation) for an extended target.
    """
    power = brightness / (range_m * range_m + np.float32(model.near_m**2))
    if model.extinction_per_m:
        power = power * np.exp(np.float32(-2 * model.extinction_per_m) * range_m)
    return power


@dataclass(frozen=True, eq=False)
class Lasers:
    """Differences between the lasers of one unit, row by row; they are the same in all scans.

    Args:
        log_gain: natural log of each laser's gain.
        reading: factor on the reflectance that each laser reports.
        offset_m: constant error of each laser's ranges, in metres.
    """

    log_gain: Float32[np.ndarray, "H 1"]
    reading: Float32[np.ndarray, "H 1"]
    offset_m: Float32[np.ndarray, "H 1"]

    @classmethod
    def of(cls, setup: SensorSetup, height: int) -> "Lasers":
        """Look up the lasers of a set-up; where it has none, all are alike."""
        lists = ((setup.log_gain, 0.0), (setup.reading, 1.0), (setup.offset_m, 0.0))
        return cls(*(np.array(each or (alike,) * height, np.float32)[:, None] for each, alike in lists))


def range_sigma_m(
    range_m: Float32[np.ndarray, "*shape"], cos_incidence: Float32[np.ndarray, "*shape"], setup: SensorSetup
) -> Float32[np.ndarray, "*shape"]:
    """Return the standard deviation of the range noise, in metres.

    A beam of finite width meets a surface that is struck at an angle at many ranges: the footprint's depth is its
    width times the tangent of incidence.
    """
    cos = np.maximum(cos_incidence, np.float32(_INCIDENCE_AT_LEAST))
    depth_m = range_m * np.float32(setup.divergence_mrad / 1e3) * np.sqrt(1 - cos * cos) / cos
    far_m = np.float32(setup.range_sigma_per_m) * range_m
    return np.sqrt(
        np.float32(setup.range_sigma_m**2) + far_m * far_m + (np.float32(setup.footprint_sigma) * depth_m) ** 2
    )


@dataclass(frozen=True, eq=False)
class BeamNoise:
    """Random numbers of the beams of one scan, besides their directions.

    Args:
        patch: natural log of the gain along a ring.
        pulse: gain noise from pulse to pulse, in standard deviations.
        range_noise: range noise, in standard deviations.
    """

    patch: Float32[np.ndarray, "H W"]
    pulse: Float32[np.ndarray, "H W"]
    range_noise: Float32[np.ndarray, "H W"]

    @classmethod
    def sample(cls, rng: np.random.Generator, height: int, width: int, model: RaydropModel) -> "BeamNoise":
        """Sample the noise of a scan of one size."""
        num_knots = max(round(360 / model.patch_deg), 1)
        knots = rng.standard_normal((height, num_knots), dtype=np.float32) * np.float32(model.patch_spread)
        position = np.arange(width, dtype=np.float32) * np.float32(num_knots / width)
        left = position.astype(np.intp)
        share = position - left.astype(np.float32)
        patch = knots[:, left] * (1 - share)
        patch += knots[:, (left + 1) % num_knots] * share
        return cls(
            patch,
            pulse=rng.standard_normal((height, width), dtype=np.float32),
            range_noise=rng.standard_normal((height, width), dtype=np.float32),
        )

    def columns(self, which: slice) -> "BeamNoise":
        """Return the noise of some columns."""
        return BeamNoise(self.patch[:, which], self.pulse[:, which], self.range_noise[:, which])


def levels(
    power: Float32[np.ndarray, "*shape"], log_gain: Float32[np.ndarray, "*shape"], model: RaydropModel
) -> Float32[np.ndarray, "*shape"]:
    """Return the natural log of power times gain over the least power; minus infinity for no power."""
    with np.errstate(divide="ignore"):
        return np.log(power * np.float32(1 / model.least_power)) + log_gain


def return_probability(
    level: Float32[np.ndarray, "*shape"], model: RaydropModel, gap_share: float
) -> Float32[np.ndarray, "*shape"]:
    """Return the probability that a pulse is fired into the pixel and, with its own chance, exceeds the least power.

    The factor from pulse to pulse is log-normal, so this is the normal distribution function of the level.

    Args:
        gap_share: share of pixels without a pulse.
    """
    if model.pulse_spread == 0:
        return (level > 0).astype(np.float32) * np.float32(1 - gap_share)
    return ndtr(level * np.float32(1 / model.pulse_spread)) * np.float32(1 - gap_share)


def reflectance(
    scattered: Float32[np.ndarray, "*shape"],
    specular: Float32[np.ndarray, "*shape"],
    level: Float32[np.ndarray, "*shape"],
    chance: Float32[np.ndarray, "*shape"],
    range_m: Float32[np.ndarray, "*shape"],
    model: RaydropModel,
    setup: SensorSetup,
) -> Float32[np.ndarray, "*shape"]:
    """Return what the sensor reports as reflectance: hundredths in [0, 0.99]; where its scale is below 1, 255ths.

    A sensor undoes range and incidence from the strength of the echo, but an HDL-64E does so to some 18 m only: beyond,
    walls and leaves fade with range, and its weak echoes read 0, as KITTI's road does at 30 m though it is seen to
    55 m. A Pandar64 reads alike at all ranges.

    Args:
        scattered: share of light that the surface scatters evenly.
        specular: light that the surface sends back besides, by gloss and retroreflection.
        level: natural log of power over the least power.
        chance: relative error of this reading.
        range_m: range of the echo.
        setup: scale and contrast of this sensor's reflectances, and how they fade.
    """
    full = np.maximum(scattered * (1 + chance) + np.float32(0.5) * specular, 0)
    if setup.reflectance_power != 1:
        full **= np.float32(setup.reflectance_power)
    full *= np.float32(setup.reflectance_scale)
    seen = (level - np.float32(model.dim_level)) * np.float32(1 / (model.bright_level - model.dim_level))
    dimmed = np.where(seen > 0, model.dim_share + (1 - model.dim_share) * np.minimum(seen, 1), 0).astype(np.float32)
    if setup.weak_dimming < 1:
        dimmed = 1 - np.float32(setup.weak_dimming) * (1 - dimmed)
    full *= dimmed
    if setup.fades_to_m:
        faded = (np.float32(setup.fades_to_m) - range_m) * np.float32(1 / (setup.fades_to_m - setup.fades_from_m))
        full *= np.clip(faded, 0, 1)
    most, steps = (0.99, 100) if setup.reflectance_scale >= 1 else (1.0, 255)
    return np.round(np.clip(full, 0, most) * np.float32(steps)) * np.float32(1 / steps)
