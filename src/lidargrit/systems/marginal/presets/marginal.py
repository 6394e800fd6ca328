"""Pixel statistics: each pixel from its own histogram over simulated or your own scans; trains in seconds."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import Preset
from lidargrit.systems.marginal.system import MarginalConfig

PRESET = Preset(
    title="marginal: every pixel sampled from its own histogram; any model should score better",
    generator="marginal",
    model=MarginalConfig(),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={},
)
