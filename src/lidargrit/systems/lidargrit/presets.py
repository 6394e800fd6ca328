"""Presets of LidarGRIT: at the paper's sizes, at sizes for CPUs, with a pixel decoder, and rows of the ablation."""

from dataclasses import replace

from lidargrit.generation import presets as shared
from lidargrit.generation.presets import preset, variant
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.nearest_range import NearestRangeConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig

_EPOCH = shared.KITTI_ODOMETRY_EPOCH
_NO_DROPOUT = {"model.transformer.embedding_dropout": 0.0, "model.transformer.residual_dropout": 0.0}
_RELEASED = {
    "model.tokenizer.reconstruction": "reference",
    "model.tokenizer.codebook_loss": "reference",
    "data.projection_variant": "reference",
    "training.tokenizer.augmentations": (),
    "training.tokenizer.average_over_scans": 0,
    "training.transformer.average_over_scans": 0,
}
"""What LidarGRIT's authors released, where it departs from their paper (hamedhaghighi/LidarGRIT@a3f86e7):

- projection (util/lidar.py): columns rounded and clipped (paper: bins of equal width);
- reconstruction loss (models/modules/losses/vqperceptual.py): the range with a sampled mask, over each scan's returns
  (paper, eq. 2: clean range, all pixels);
- codebook loss (models/modules/vqvae/quantize.py): 0.25 on the term that moves the codes (paper: both terms alike);
- no geometric preservation: ``do_gp: False`` (paper, section 3.2.2: on);
- no moving average of the weights, which the paper does not mention either, and which is ours.

Learning rates, batches and epochs are the same in both: the paper gives none, and its presets have them from the files
of configs/train_cfg. ``row_drop`` and ``col_drop`` there, which hide rows and columns of the input, are not built.
The program samples among the 100 likeliest tokens: ``sample --set sampling.top_k=100``. It trains on drive 0005, too,
and chooses weights by drives that it trains or is tested on; that is not repeated (see docs/data.md).
"""

_RELAYED = TrainingConfig(
    scans=60_000,
    batch_size=16,
    learning_rate=1e-3,
    schedule="linear_second_half",  # minutes of a GPU end when they end: it falls only once half of the scans are seen
    warmup_scans=1600,
    betas=(0.9, 0.98),
    precision="auto",
    any_columns=True,
    average_over_scans=2000,
    validate_every=10_000,
    checkpoint_every=10_000,
)
_KITTI_360 = preset(  # 17.3 M + 10.3 M parameters
    "LidarGRIT on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    shared.KITTI_360,
    LidarGritConfig(shared.KITTI_360_VQVAE, TransformerConfig(layers=12, heads=8, width=256, embedding_dropout=0.0)),
    seed=6,
    published="SWD 10.29e-2, BEV MMD 2.16e-4, BEV JSD 3.93e-2, FPD 12.54 (paper, table 1; 5,000 test scans)",
    tokenizer=shared.KITTI_360_TOKENIZER,
    transformer=replace(
        shared.KITTI_360_TOKENIZER,
        batch_size=16,
        learning_rate=7.2e-5,
        schedule="linear_second_half",
        betas=(0.9, 0.95),
        weight_decay=0.01,
        augmentations=(),
    ),
)
_KITTI_ODOMETRY = preset(  # 3.1 M + 5.3 M parameters
    "LidarGRIT on KITTI odometry (set data.train and data.val to kitti_odometry:ROOT:SPLIT)",
    shared.KITTI_ODOMETRY,
    LidarGritConfig(
        VqvaeConfig(channels=64, channel_multipliers=(1, 1, 2), code_dim=128, num_codes=512, restart_dead_codes=False),
        TransformerConfig(layers=6, heads=8, width=256, embedding_dropout=0.2),
    ),
    seed=6,
    published="SWD 15.15e-2, min. matching distance 1.65e-3, JSD 2.06e-2, FPD 116 (paper, table 2; 5,000 test scans)",
    tokenizer=replace(shared.KITTI_360_TOKENIZER, scans=70 * _EPOCH, validate_every=_EPOCH),
    transformer=replace(
        _KITTI_360.training["transformer"],
        scans=100 * _EPOCH,
        batch_size=1,
        learning_rate=4.5e-6,
        schedule="constant",
        validate_every=_EPOCH,
    ),
)
# Haghighi et al., LidarGRIT, 2024, section 4.3 and table 3; its third row is the preset above.
_KITTI_ODOMETRY_RAYDROP = variant(
    "the paper's ablation, row 2: with raydrop loss, without geometric preservation",
    _KITTI_ODOMETRY,
    {
        "training.tokenizer.augmentations": (),
        "published": (
            "SWD 17.68e-2, min. matching distance 1.66e-3, JSD 1.99e-2, FPD 122 (paper, table 3; 5,000 test scans)"
        ),
    },
)

_SMALL = preset(
    "LidarGRIT, small: 64x256, for two CPU cores and an hour or two",
    shared.STREETS,
    LidarGritConfig(shared.SMALL_VQVAE, shared.SMALL_TRANSFORMER),
    tokenizer=shared.SMALL_STAGES["tokenizer"],
    transformer=shared.SMALL_STAGES["transformer"],
)
# A flip is one of the maps of geometric preservation. So that the rows of the ablation differ in nothing but what is
# ablated, all three show the scans as they are, in both stages; the third alone adds geometric preservation, to the
# VQ-VAE only, as in the paper. Range encoding, unit of errors and codebook are those of the small preset: in its
# logarithmic encoding the first row takes returns nearer than 1.2 m for ray drops, in the paper's all within 6.9 m.
_SMALL_RAYDROP = variant(
    "the ablation, small, row 2: with raydrop loss, without geometric preservation",
    _SMALL,
    {f"training.{stage}.augmentations": () for stage in shared.SMALL_STAGES}
    | {f"training.{stage}.any_columns": False for stage in shared.SMALL_STAGES},
)
# A quarter of the tokens for little of their detail: the transformer learns, and generates, sooner.
_COMPACT = variant(
    "LidarGRIT: 64x256 in 256 tokens, for one CPU core and an hour",
    _SMALL,
    {
        "model.tokenizer.channel_multipliers": (1, 1, 2, 4),
        "model.tokenizer.num_codes": 1024,
        "model.transformer.layers": 5,
        "model.transformer.width": 256,
        "training.tokenizer.scans": 8000,
    },
)
# From as many scans, the transformer learns more by Muon than by AdamW at the learning rate that suits each.
_BY_MUON = replace(shared.SMALL_STAGES["transformer"], optimiser="muon", learning_rate=3e-3)
_COMPACT_PIXELS = variant(
    "LidarGRIT with a pixel decoder: 64x256 in 256 tokens, for one CPU core and ten hours",
    _COMPACT,
    {
        **_NO_DROPOUT,  # no image comes often enough that dropout would prevent anything
        # Sizes that leave the packaged model, rounded to 8 bits, below 12 MB.
        "model.pixels": replace(shared.PIXEL_DECODER, mask_features=6, coarse_range_width=48),
        # Chosen on validation streets: at 1, shares of drops differ too little between scans and between regions.
        "model.guidance": 1.15,
        "data.train": ("simulated:70000:train",),
        # Scans are not symmetric: the car hides rays on one side. From mirrored ones, half of the samples are mirrored.
        "training.transformer": replace(_BY_MUON, scans=220_000, average_over_scans=1000, augmentations=()),
        "training.pixels": shared.PIXELS,
    },
)
_OF_FINE_CELLS = TransformerConfig(
    heads=4, embedding_dropout=0.0, neighbours=True, code_features=True, window_columns=32
)
_BESIDE_FINE_CELLS = replace(
    shared.PIXEL_DECODER,
    coarsest_cell=16,
    mask_features=6,
    decoded_components=True,
    weighed_components=True,
    range_temperature=0.2,  # for pixels that learn beside true neighbours last
    surface_temperature=0.5,  # tokens tell where thin objects stand, which are lost without them
    mask_temperature=0.3,  # windows are salt and pepper at 1
)
_FOR_A_DEMO = {
    "data.train": ("simulated:256:train",),
    "data.val": shared.DEMO_STREETS.val,
    "model.guidance": 1.0,  # that of `pretrained` was chosen for its transformer
    # Half as wide, a transformer learns nearly as much from a scan, and sees twice as many in the same time.
    "model.transformer.layers": 3,
    "model.transformer.width": 192,
    "training.transformer.scans": 2400,
    "training.transformer.warmup_scans": 160,
    "training.transformer.average_over_scans": 160,
    "training.transformer.validate_every": 1200,
    "training.transformer.validation_scans": 16,
    "training.transformer.checkpoint_every": 480,
}
_FURTHER = {
    "warmup_scans": 40,
    "validate_every": 400,
    "validation_scans": 8,
    "checkpoint_every": 80,
    "start": "pretrained",
}
_STAGES = _COMPACT_PIXELS.training

PRESETS = {
    "lidargrit_small": _SMALL,
    "lidargrit_compact": _COMPACT,
    "lidargrit_compact_pixels": _COMPACT_PIXELS,
    "lidargrit_wide_pixels": variant(
        "LidarGRIT with a pixel decoder: 64x1024 in 1,024 tokens, for one CPU core and five hours",
        _COMPACT_PIXELS,
        {
            # Columns are four times as near as those of 64x256: at its temperature there are too many edges.
            "model.pixels.range_temperature": 0.2,
            "model.guidance": 1.0,  # without any, regions of its samples differ in drops as validation streets do
            "data": replace(shared.WIDE_STREETS, train=("simulated:70000:train",)),
            # An image of 64x1024 is as much to learn from as four of 64x256.
            "training.tokenizer": replace(
                _STAGES["tokenizer"],
                scans=800,
                batch_size=1,
                learning_rate=5e-4,
                validate_every=400,
                start="pretrained",
            ),
            "training.transformer": replace(
                _STAGES["transformer"], scans=17_600, batch_size=4, validate_every=1200, start="pretrained"
            ),
            "training.pixels": replace(
                shared.PIXELS, scans=12_200, batch_size=1, learning_rate=1e-3, start="pretrained"
            ),
        },
    ),
    "lidargrit_fine_small": preset(
        "LidarGRIT with a pixel decoder: 64x256 in 1,024 tokens of nearest ranges, for one CPU core and four hours",
        shared.MORE_STREETS,
        LidarGritConfig(
            NearestRangeConfig(),
            replace(_OF_FINE_CELLS, layers=4, width=160, windows_per_scan=2),
            replace(_BESIDE_FINE_CELLS, row_halvings=2),  # columns are 1.4 degrees apart and rows 0.4
        ),
        tokenizer=replace(shared.SMALL_STAGES["tokenizer"], scans=8000, augmentations=()),
        transformer=replace(_BY_MUON, scans=40_000, weight_decay=0.0, augmentations=()),
        pixels=replace(shared.PIXELS, scans=20_000, optimiser="muon"),
    ),
    "lidargrit_fine_wide": preset(
        "LidarGRIT with a pixel decoder: 64x1024 in 4,096 tokens of nearest ranges, for half an hour of a GPU",
        replace(shared.WIDE_STREETS, train=("simulated:70000:train",), workers=16),
        LidarGritConfig(
            NearestRangeConfig(cell_rows=4, cell_columns=4),
            replace(_OF_FINE_CELLS, windows_per_scan=4),
            replace(_BESIDE_FINE_CELLS, column_halvings=2, coarse_range_width=48),  # columns are closer than rows
        ),
        tokenizer=replace(_RELAYED, scans=10_000, learning_rate=2e-3, augmentations=("flip",)),
        transformer=replace(_RELAYED, scans=100_000, optimiser="muon", learning_rate=3e-3),
        pixels=replace(_RELAYED, optimiser="muon", learning_rate=2e-3),
    ),
    "lidargrit_demo": preset(
        "LidarGRIT, demo: the small model for a few minutes",
        shared.DEMO_STREETS,
        _SMALL.model,
        tokenizer=shared.DEMO_STAGES["tokenizer"],
        transformer=shared.DEMO_STAGES["transformer"],
    ),
    "lidargrit_demo_transformer": variant(
        "LidarGRIT whose transformer is trained further, demo: 64x256 in 256 tokens, for two CPU cores and a minute",
        _COMPACT_PIXELS,
        {
            "data.train": ("simulated:96:train",),
            "data.val": ("simulated:32:val",),
            "training.transformer": replace(
                _STAGES["transformer"], scans=160, learning_rate=6e-4, average_over_scans=40, **_FURTHER
            ),
            "training.tokenizer.start": "frozen:pretrained",
            "training.pixels.start": "frozen:pretrained",
        },
    ),
    "lidargrit_demo_fine_tuned": variant(
        "LidarGRIT trained further, demo: 64x256 in 256 tokens, for two CPU cores and four minutes",
        _COMPACT_PIXELS,
        {
            # A fifth of the rates at which the weights were learned, as docs/how-to/train.md says.
            "training.tokenizer": replace(
                _STAGES["tokenizer"], scans=200, learning_rate=3e-4, average_over_scans=40, **_FURTHER
            ),
            "training.transformer": replace(
                _STAGES["transformer"], scans=800, learning_rate=6e-4, average_over_scans=80, **_FURTHER
            ),
            "training.pixels": replace(shared.PIXELS, scans=240, learning_rate=4e-4, average_over_scans=40, **_FURTHER),
        },
    ),
    # Few codes, a small transformer and small batches: more to learn from as few scans as minutes allow.
    # In 32 bits a scan costs the tokenizer 0.4, the transformer 0.08 and the pixel decoder 0.27 seconds of one core.
    "lidargrit_demo_pixels": variant(
        "LidarGRIT with a pixel decoder, demo: 64x256 in 256 tokens, for two CPU cores and ten minutes",
        _COMPACT_PIXELS,
        {
            **_FOR_A_DEMO,
            "model.tokenizer.num_codes": 256,
            "training.tokenizer": replace(
                _STAGES["tokenizer"],
                scans=600,
                warmup_scans=40,
                average_over_scans=60,
                validate_every=300,
                validation_scans=8,
                checkpoint_every=150,
            ),
            "training.transformer.validation_scans": 8,
            "training.pixels": replace(
                shared.PIXELS,
                scans=280,
                warmup_scans=28,
                average_over_scans=28,
                validate_every=140,
                validation_scans=8,
                checkpoint_every=70,
            ),
        },
    ),
    "lidargrit_kitti_360": _KITTI_360,
    "lidargrit_kitti_odometry": _KITTI_ODOMETRY,
    "lidargrit_kitti_360_reference": variant(
        "LidarGRIT on KITTI-360 as released (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        _KITTI_360,
        {**_RELEASED, "data.columns": 2048, "data.column_stride": 2},  # of 2048 columns every second is kept
    ),
    "lidargrit_kitti_odometry_reference": variant(
        "LidarGRIT on KITTI odometry as released (set data.train and data.val to kitti_odometry:ROOT:SPLIT)",
        _KITTI_ODOMETRY,
        {**_RELEASED, "model.tokenizer.raydrop_weight": 1e-4},  # paper: 0.1; so had the configuration of April 2024
    ),
}
TO_COMPARE_WITH = {
    # One channel learns the range image with its ray drops, by the plain mean error; a pixel that is decoded near the
    # shortest range is a ray drop. The paper does not give this rule; it is that of hamedhaghighi/LidarGRIT@a3f86e7,
    # which with its linear encoding takes returns nearer than 6.9 m for drops.
    "lidargrit_kitti_odometry_neither": variant(
        "the paper's ablation, row 1: without raydrop loss and geometric preservation",
        _KITTI_ODOMETRY_RAYDROP,
        {
            "model.tokenizer.raydrop_loss": False,
            "published": (
                "SWD 61.73e-2, min. matching distance 1.73e-3, JSD 2.82e-2, FPD 212 (paper, table 3; 5,000 test scans)"
            ),
        },
    ),
    "lidargrit_kitti_odometry_raydrop": _KITTI_ODOMETRY_RAYDROP,
    "lidargrit_small_neither": variant(
        "the ablation, small, row 1: without raydrop loss and geometric preservation",
        _SMALL_RAYDROP,
        {"model.tokenizer.raydrop_loss": False},
    ),
    "lidargrit_small_raydrop": _SMALL_RAYDROP,
    "lidargrit_small_both": variant(
        "the ablation, small, row 3: with raydrop loss and geometric preservation",
        _SMALL_RAYDROP,
        {"training.tokenizer.augmentations": ("geometric",)},
    ),
}
