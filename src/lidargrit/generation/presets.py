"""A preset is an entry of a table: name → :class:`Preset`; and what the presets of several systems share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lidargrit.core import configuration, discovery
from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load_class
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig

_SCANS = 2000  # of each stage of a default preset: minutes, not hours

STREETS = DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",))
MORE_STREETS = replace(STREETS, train=("simulated:4352:train",))
WIDE_STREETS = DataConfig(("simulated:1000:train",), ("simulated:24:val",), columns=2048, column_stride=2)
# One street for a dozen sensors would save a fourth of the time at most: of a scan's 128 ms the scene takes 20, and its
# tree 13; the rest are each sensor's own rays.
_SENSORS = 64


def any_sensor(data_set: str, streets: int) -> DataConfig:
    """Return the data of a model for any sensor: streets, of which each drawn sensor sees others."""
    return DataConfig(
        tuple(
            f"{data_set}:{streets}@drawn_{n}:train[{100 * n / _SENSORS:g}%:{100 * (n + 1) / _SENSORS:g}%]"
            for n in range(_SENSORS)
        ),
        tuple(f"{data_set}:24@drawn_{n}:val[{25 * (n - 1000)}%:{25 * (n - 999)}%]" for n in range(1000, 1004)),
        columns=2048,
        column_stride=8,
        own_sensors=True,
    )


ANY_SENSOR = any_sensor("simulated", 4352)
DEMO_STREETS = DataConfig(train=("simulated:300:train",), val=("simulated:16:val",))
KITTI_360 = DataConfig(
    ("kitti_360:data/kitti_360:train_without_val",), ("kitti_360:data/kitti_360:val",), "hdl64e_kitti_360"
)
KITTI_ODOMETRY = DataConfig(("kitti_odometry:data/kitti_odometry:train",), ("kitti_odometry:data/kitti_odometry:val",))
NUSCENES = DataConfig(("nuscenes:data/nuscenes:train",), ("nuscenes:data/nuscenes:val",), "hdl32e", columns=1024)

KITTI_360_EPOCH = 50_000
"""Number of scans of the training drives, roughly."""
KITTI_ODOMETRY_EPOCH = 19_130
"""Number of scans of the training sequences 00 to 07, 09 and 10."""

MINUTES = TrainingConfig(
    scans=20_000,
    batch_size=4,
    learning_rate=1e-3,
    schedule="cosine",
    warmup_scans=400,
    betas=(0.9, 0.99),
    precision="auto",
    augmentations=("flip",),
    any_columns=True,
    average_over_scans=500,
    validate_every=1000,
    checkpoint_every=500,
)
"""Training of a small network on two CPU cores, on simulated or on a user's scans."""
LATER_STAGE = replace(MINUTES, batch_size=2, learning_rate=2e-3, warmup_scans=200, betas=(0.9, 0.98), augmentations=())
"""Training of a network over what ``pretrained`` has: its pixel decoder, its completion, its raydrop."""
PIXELS = replace(LATER_STAGE, scans=58_000, average_over_scans=1200)
"""Training of the pixel decoder of ``pretrained``."""
GAN_MINUTES = TrainingConfig(
    scans=60_000,
    batch_size=16,
    learning_rate=1e-4,
    betas=(0.0, 0.99),
    gradient_clip=0.0,
    augmentations=("flip",),
    any_columns=True,
    average_over_scans=0,
    validate_every=4000,
    checkpoint_every=4000,
)
"""The same for two networks that take turns."""
DIFFUSION_ON_KITTI_360 = TrainingConfig(
    scans=2_560_000,
    batch_size=8,
    learning_rate=1e-4,
    schedule="cosine",
    warmup_scans=80_000,
    betas=(0.9, 0.99),
    average_over_scans=11_000,  # half-life of a decay of 0.995 every 10 steps of 8 scans
    validate_every=50_000,
    checkpoint_every=10_000,
)
"""Training of R2Flow, and but for scans and precision of R2DM."""

SMALL_VQVAE = VqvaeConfig(
    channels=32,
    channel_multipliers=(1, 1, 2),
    code_dim=64,
    num_codes=512,
    dropout=0.0,
    padding="wrap",
    range_encoding="log",  # with errors in metres learns quicker than the linear one, see docs/decisions/0008
    error_unit="metres",
    reconstruction="returns",
    codebook_loss="ema",
)
SMALL_TRANSFORMER = TransformerConfig(layers=4, heads=4, width=192, embedding_dropout=0.1, residual_dropout=0.1)
SMALL_STAGES = {
    "tokenizer": replace(
        MINUTES,
        batch_size=2,
        learning_rate=1.5e-3,
        warmup_scans=300,
        betas=(0.9, 0.95),
        augmentations=("flip", "roll"),
        average_over_scans=300,
    ),
    "transformer": replace(MINUTES, batch_size=8, warmup_scans=500, betas=(0.9, 0.95), weight_decay=0.01),
}
"""Training of both networks of LidarGRIT, small."""
DEMO_STAGES = {
    "tokenizer": replace(SMALL_STAGES["tokenizer"], scans=2400, validate_every=800, checkpoint_every=400),
    "transformer": replace(SMALL_STAGES["transformer"], scans=4800, validate_every=1600, checkpoint_every=400),
}
"""The same for minutes."""
KITTI_360_VQVAE = VqvaeConfig(
    channels=128, channel_multipliers=(1, 1, 2, 2), code_dim=256, num_codes=1024, restart_dead_codes=False
)
KITTI_360_TOKENIZER = TrainingConfig(
    scans=100 * KITTI_360_EPOCH,
    batch_size=8,
    learning_rate=8e-6,
    betas=(0.5, 0.9),
    gradient_clip=0.0,
    augmentations=("geometric",),
    average_over_scans=20_000,
    validate_every=KITTI_360_EPOCH,
    checkpoint_every=10_000,
)
"""Training of the VQ-VAE that LidarGRIT's paper has for KITTI-360."""
PIXEL_DECODER = PixelDecoderConfig(
    coarsest_cell=64, row_channels=2, range_width=36, surface_components=True, gravity_components=True
)


def preset(
    title: str, data: DataConfig, model: Any, *, seed: int = 0, published: str = "", **training: TrainingConfig
) -> Preset:
    """Return a preset of the system whose configuration the model is.

    Args:
        published: scores that a paper reports.
        training: settings of the training of each stage.
    """
    generator = type(model).__module__.split(".")[-2]  # the folder of the system, systems/NAME/system.py
    return Preset(title, generator, model, data, training, seed, published)


def variant(title: str, base: Preset, settings: Mapping[str, Any]) -> Preset:
    """Return a preset that differs from another by its title and by the settings named.

    Args:
        settings: other values, by the dotted names of settings or parts.
    """
    return configuration.changed(base, {"title": title, **settings})


def load_preset(name: str, settings: Sequence[str] = ()) -> Preset:
    """Return a preset by its name, with settings changed as in ``training.tokenizer.batch_size=4``.

    The name of a generator that has no preset of this name gives its default preset, see :func:`default_preset`.

    Raises:
        UnknownNameError: no such preset and no such generator.
        ConfigError: an unknown setting or a value that does not fit, of which it names the nearest; or a folder.
    """
    if not is_preset(name) and Path(name).is_dir():
        raise ConfigError(
            f"{name}, a folder that holds no finished run",
            "a preset, or where systems are compared a finished run or samples",
            "see lidargrit list presets; score scans with lidargrit evaluate",
        )
    is_generator = is_preset(name) and name not in discovery.names("presets")
    found = default_preset(name) if is_generator else discovery.load_instance("presets", name, Preset)
    return configuration.override(found, settings, f"the preset {name!r}")


def is_preset(name: str) -> bool:
    """Return whether :func:`load_preset` knows a name, of a preset or of a generator."""
    return name in (*discovery.names("presets"), *discovery.names("generators"))


def default_preset(generator: str) -> Preset:
    """Return a preset for a generator that has none: its default configuration, and minutes on simulated streets.

    Args:
        generator: name of the generator.

    Raises:
        ConfigError: the generator's configuration has a setting without a default.
    """
    cls, data = load_class(generator), replace(STREETS, train=("simulated:256:train",), val=("simulated:16:val",))
    try:
        config = cls.Config()
    except TypeError as error:
        wanted = f"a default for every setting of {cls.Config.__name__}"
        raise ConfigError(
            f"{generator} without a preset ({error})", wanted, f"add {generator} to systems/{generator}/presets.py"
        ) from None
    each = TrainingConfig(
        scans=_SCANS,
        batch_size=4,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_scans=100,
        average_over_scans=100,
        precision=cls.training_precision,
        validate_every=500,
        validation_scans=16,
        checkpoint_every=500,
    )
    stages = cls(config, data.load_sensor()).stages
    title = f"{generator} as its default configuration makes it, on simulated streets"
    return Preset(title, generator, config, data, dict.fromkeys(stages, each))
