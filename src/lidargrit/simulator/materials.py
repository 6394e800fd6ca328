"""Materials of surfaces: a name → how the material reflects a beam of 905 nm."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """Reflection properties of one kind of surface; the albedo belongs to each triangle.

    Args:
        diffuse: factor on the triangle's albedo, the share scattered evenly; clear coats and panes scatter little.
        gloss: strength of the mirror-like lobe, seen only close to normal incidence.
        lobe_power: exponent of the cosine of incidence in that lobe; the higher, the narrower.
        retroreflection: strength of the lobe that goes straight back whatever the incidence (foils, number plates).
        passes: share of the light that goes through (glass).
        mottle: relative variation of its reflectance from spot to spot: leaves face all directions, plaster is rough.
    """

    name: str
    diffuse: float = 1.0
    gloss: float = 0.0
    lobe_power: float = 1.0
    retroreflection: float = 0.0
    passes: float = 0.0
    mottle: float = 0.0


ASPHALT, CONCRETE, PLASTER, BRICK, METAL, PAINT, GLASS, FOIL, LEAVES, BARK, CLOTH, SKIN, RUBBER, GRASS, WATER = range(
    15
)

# Fitted to 67 scans of KITTI by benchmarks/fit_raydrop.py: diffuse of asphalt to leaves and grass, gloss of paint,
# diffuse and passes of glass, foil. With them come the albedos that the scenes sample, so a diffuse may be above 1.
# Plaster and brick were then made brighter by .15, until the reflectance of all scans together was as near as before:
# in labelled scans walls read brighter than roads (.42 and .25).
# Diffuse of paint and leaves is then set by hand: cars read 0 or .2 to .4, so bright paint scatters as plaster does;
# leaves read a little too bright with KITTI's sensor and too dark with PandaSet's.
# Mottle is set so that readings of one class spread as in labelled scans.
# The other numbers are set by eye: bodies of cars fade out in rows, their windows are dark.
MATERIALS: tuple[Material, ...] = (
    Material("asphalt", diffuse=1.66),
    Material("concrete", diffuse=1.09, mottle=0.06),
    Material("plaster", diffuse=0.82, mottle=0.1),
    Material("brick", diffuse=1.17, mottle=0.12),
    Material("metal", gloss=0.966, lobe_power=30.0),
    Material("paint", diffuse=1.0, gloss=1.36, lobe_power=45.6),
    # Clear glass would pass 0.9; that of cars and houses is made to keep heat out, which begins at this wavelength.
    Material("glass", diffuse=0.0093, gloss=0.00258, lobe_power=40.0, passes=0.2),
    Material("foil", retroreflection=32.4),
    Material("leaves", diffuse=0.9, mottle=0.16),
    Material("bark", mottle=0.4),
    Material("cloth"),
    Material("skin"),
    Material("rubber"),
    Material("grass", diffuse=0.899, mottle=0.12),
    Material("water", gloss=0.02, lobe_power=200.0, passes=0.95),
)
