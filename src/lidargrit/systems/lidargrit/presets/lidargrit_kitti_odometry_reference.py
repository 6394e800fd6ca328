"""KITTI odometry by the configuration that LidarGRIT's authors released, where it departs from their paper.

What differs from ``lidargrit_kitti_odometry``:

- raydrop loss: weight 0.0001 (paper: 0.1; so had the configuration of April 2024);
- projection: columns rounded and clipped (paper: bins of equal width);
- reconstruction loss: the range with a sampled mask, over each scan's returns (paper, eq. 2: clean range, all pixels);
- codebook loss: 0.25 on the term that moves the codes (paper: both terms alike);
- no geometric preservation: ``do_gp: False`` (paper, section 3.2.2: on);
- no moving average of the weights, which the paper does not mention either, and which is ours.

What is the same in both, what is not built and what is not repeated, says ``lidargrit_kitti_360_reference``.

Source:
    hamedhaghighi/LidarGRIT@a3f86e7, configs/train_cfg/vqgan.yaml and transformer.yaml, and the files named there.
"""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import lidargrit_kitti_odometry

_PAPER = lidargrit_kitti_odometry.PRESET

PRESET = replace(
    _PAPER,
    title="LidarGRIT on KITTI odometry as released (set data.train and data.val to kitti_odometry:ROOT:SPLIT)",
    model=replace(
        _PAPER.model,
        tokenizer=replace(
            _PAPER.model.tokenizer, reconstruction="reference", codebook_loss="reference", raydrop_weight=1e-4
        ),
    ),
    data=replace(_PAPER.data, projection_variant="reference"),
    training={
        stage: replace(config, augmentations=(), average_over_scans=0) for stage, config in _PAPER.training.items()
    },
)
