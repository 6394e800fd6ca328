"""Presets of the memorised training scans."""

from lidargrit.generation.presets import STREETS, preset
from lidargrit.systems.memorised.system import MemorisedConfig

PRESETS = {
    "memorised": preset("memorised: training scans given back; few models can score better", STREETS, MemorisedConfig())
}
