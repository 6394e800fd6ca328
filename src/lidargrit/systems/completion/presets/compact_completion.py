"""The network that completes scans of ``pretrained``, fed by triangulation."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Recipe
from lidargrit.systems.completion.system import CompletionConfig

RECIPE = Recipe(
    title="a network that completes scans: 64x256, for one CPU core and an hour",
    generator="completion",
    model=CompletionConfig(),
    data=DataConfig(train=("simulated:4352:train",), val=("simulated:32:val",)),
    training={
        "completion": FitConfig(
            scans=22_000,
            batch_size=4,
            learning_rate=1.5e-3,
            schedule="cosine",
            warmup_scans=200,
            betas=(0.9, 0.98),
            precision="auto",
            any_columns=True,
            augmentations=("flip",),
            average_over_scans=600,
            validate_every=2000,
            checkpoint_every=500,
        ),
    },
)
