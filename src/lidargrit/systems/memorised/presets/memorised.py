"""Memorised training scans, as a reference row; simulated or your own scans; trains in seconds."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import Preset
from lidargrit.systems.memorised.system import MemorisedConfig

PRESET = Preset(
    title="memorised: training scans given back; few models can score better",
    generator="memorised",
    model=MemorisedConfig(),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={},
)
