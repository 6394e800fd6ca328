"""The network of raydrop of ``pretrained``, trained on simulated streets of which all surfaces are known."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Recipe
from lidargrit.systems.raydrop.system import RaydropConfig

RECIPE = Recipe(
    title="a network of raydrop for clean scans: 64x256, for one CPU core and ten minutes",
    generator="raydrop",
    model=RaydropConfig(),
    data=DataConfig(train=("simulated_surfaces:512:train",), val=("simulated_surfaces:64:val",)),
    training={
        "raydrop": FitConfig(
            scans=4000,
            batch_size=4,
            learning_rate=2e-3,
            schedule="cosine",
            warmup_scans=200,
            betas=(0.9, 0.98),
            precision="auto",
            any_columns=True,
            augmentations=("flip",),
            average_over_scans=300,
            validate_every=1000,
            validation_scans=32,
            checkpoint_every=500,
        ),
    },
)
