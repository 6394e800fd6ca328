"""Memorised training scans, as a reference row; simulated or your own scans; trains in seconds."""

from lidargrit.generators.memorised import MemorisedConfig
from lidargrit.loading import DataConfig
from lidargrit.training import Recipe

RECIPE = Recipe(
    title="memorised: training scans given back; few models can score better",
    generator="memorised",
    model=MemorisedConfig(),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={},
)
