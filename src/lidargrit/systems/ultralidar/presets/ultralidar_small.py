"""UltraLiDAR at a size that two CPU cores can train in an hour: 20x256x256 voxels, 1,024 tokens, 1.9 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.ultralidar.swin import SwinConfig
from lidargrit.systems.ultralidar.system import UltraLidarConfig
from lidargrit.systems.ultralidar.voxel_autoencoder import VoxelAutoencoderConfig
from lidargrit.systems.ultralidar.voxels import VoxelGrid

_FIT = FitConfig(
    scans=12_000,
    batch_size=4,
    learning_rate=1e-3,
    schedule="cosine",
    warmup_scans=400,
    weight_decay=0.01,
    gradient_clip=5.0,
    precision="auto",
    augmentations=("flip",),
    any_columns=True,
    average_over_scans=500,
    validate_every=1000,
    checkpoint_every=500,
)

PRESET = Preset(
    title="UltraLiDAR, small: cells of 0.39 m, 1,024 tokens, for two CPU cores",
    generator="ultralidar",
    model=UltraLidarConfig(
        autoencoder=VoxelAutoencoderConfig(
            grid=VoxelGrid(cell_m=(0.390625, 0.390625, 0.3), cells=(256, 256, 20)),
            blocks=SwinConfig(width=96, heads=4, blocks=4),
            num_codes=256,
            code_dim=64,
        ),
        prior=SwinConfig(width=96, heads=4, blocks=6),
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={"autoencoder": _FIT, "prior": _FIT},
)
