"""The diffusion of lidm_kitti_360 over the VQ-VAE of lidargrit_kitti_360: a comparison that no paper has made.

With ``--set tokenizer_from=RUN`` it takes the very tokenizer of a trained run of that preset. Noise is added along the
principal axes of its codes, as in lidm_shared_small.
"""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import lidargrit_kitti_360
from lidargrit.systems.lidm.presets import lidm_kitti_360

PRESET = replace(
    lidm_kitti_360.PRESET,
    title="LiDM's diffusion over LidarGRIT's VQ-VAE, KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    model=replace(lidm_kitti_360.PRESET.model, tokenizer=lidargrit_kitti_360.PRESET.model.tokenizer, latent_axes=8),
    data=lidargrit_kitti_360.PRESET.data,
    training={
        **lidm_kitti_360.PRESET.training,
        "tokenizer": lidargrit_kitti_360.PRESET.training["tokenizer"],
    },
    published="",
)
