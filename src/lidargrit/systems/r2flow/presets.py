"""Presets of R2Flow (1-RF), and of its later trainings: reflow straightens the flow, and distillation follows."""

from dataclasses import replace

from lidargrit.generation.presets import DIFFUSION_ON_KITTI_360, KITTI_360, MINUTES, STREETS, preset, variant
from lidargrit.systems.r2flow.hdit import HditConfig
from lidargrit.systems.r2flow.system import R2flowConfig, ReflowConfig

_SMALL = preset(
    "R2Flow (1-RF), small: 64x256, for two CPU cores",
    STREETS,
    R2flowConfig(
        HditConfig(channels=24, time_channels=64, depths=(2, 2, 2, 2), heads=(1, 2, 4, 8)),
        reflectance=False,  # most other presets of this size learn the range alone
    ),
    flow=MINUTES,
)
_KITTI_360 = preset(  # 80.9 M parameters
    "R2Flow (1-RF) on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    KITTI_360,
    R2flowConfig(),
    flow=DIFFUSION_ON_KITTI_360,
)
_FURTHER = replace(MINUTES, scans=8_000, learning_rate=3e-4, warmup_scans=200, augmentations=())  # pairs do not mirror

PRESETS = {"r2flow_small": _SMALL, "r2flow_kitti_360": _KITTI_360}
# With ``--set training.flow.start=frozen:RUN`` these take the flow of a run of the presets above, and train the rest.
TO_COMPARE_WITH = {
    "r2flow_small_reflow": variant(
        "R2Flow (2-RF, 1-TD), small: 64x256 in one step, for two CPU cores",
        _SMALL,
        {
            # The adaptive solver would take most of the training's time.
            "model.reflow": ReflowConfig(4_000, distilled_steps=1, distilled_pairs=4_000, pair_steps=16),
            "training.reflow": _FURTHER,
            "training.distillation": _FURTHER,
        },
    ),
    # A million pairs straighten the flow, 100,000 distil it; to 1, 2 or 4 steps (``model.reflow.distilled_steps``).
    # The program changes no setting of the later trainings.
    "r2flow_kitti_360_reflow": variant(
        "R2Flow (2-RF, 4-TD) on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        _KITTI_360,
        {
            "model.reflow": ReflowConfig(distilled_steps=4),
            "training.reflow": DIFFUSION_ON_KITTI_360,
            "training.distillation": DIFFUSION_ON_KITTI_360,
        },
    ),
}
