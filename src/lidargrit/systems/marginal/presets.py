"""Presets of the pixel statistics."""

from lidargrit.generation.presets import STREETS, preset
from lidargrit.systems.marginal.system import MarginalConfig

PRESETS = {
    "marginal": preset(
        "marginal: every pixel sampled from its own histogram; any model should score better", STREETS, MarginalConfig()
    )
}
