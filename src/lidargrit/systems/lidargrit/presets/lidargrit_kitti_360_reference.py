"""KITTI-360 by the configuration that LidarGRIT's authors released, where it departs from their paper.

What differs from ``lidargrit_kitti_360``:

- projection: 2048 columns, rounded and clipped, of which every second is kept (paper: bins of equal width);
- reconstruction loss: the range with a sampled mask, over each scan's returns (paper, eq. 2: clean range, all pixels);
- codebook loss: 0.25 on the term that moves the codes (paper: both terms alike);
- no geometric preservation: ``do_gp: False`` (paper, section 3.2.2: on);
- no moving average of the weights, which the paper does not mention either, and which is ours.

Learning rates, batches and epochs are the same in both: the paper gives none, and ``lidargrit_kitti_360`` has them
from here. The configuration's ``row_drop`` and ``col_drop``, which hide rows and columns of the input, are not built.
Its program samples among the 100 likeliest tokens: ``lidargrit sample --set top_k=100``. It trains on drive 0005, too,
and chooses weights by drives that it trains or is tested on; that is not repeated (see docs/data.md).

Source:
    hamedhaghighi/LidarGRIT@a3f86e7, configs/train_cfg/vqgan_360.yaml and transformer_360.yaml; the projection from
    util/lidar.py, losses from models/modules/losses/vqperceptual.py and models/modules/vqvae/quantize.py.
"""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import lidargrit_kitti_360

_PAPER = lidargrit_kitti_360.PRESET

PRESET = replace(
    _PAPER,
    title="LidarGRIT on KITTI-360 as released (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    model=replace(
        _PAPER.model,
        tokenizer=replace(_PAPER.model.tokenizer, reconstruction="reference", codebook_loss="reference"),
    ),
    data=replace(_PAPER.data, columns=2048, column_stride=2, projection_variant="reference"),
    training={
        stage: replace(config, augmentations=(), average_over_scans=0) for stage, config in _PAPER.training.items()
    },
)
