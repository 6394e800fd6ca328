"""A checkpoint of UltraLiDAR's program → sizes and weights of its networks.

Such a file is a dictionary written by mmcv, of which ``state_dict`` is read: all networks of the model, and tables that
follow from its sizes.

Source:
    myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT).
"""

import re
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from lidargrit.core.errors import CheckpointError
from lidargrit.nn.published import RefusedFileError, float_tensors, read_everything, refused_as
from lidargrit.systems.ultralidar.swin import SwinConfig
from lidargrit.systems.ultralidar.voxel_autoencoder import VoxelAutoencoderConfig

_BYTES_AT_MOST = 3 << 30  # weights and the optimiser's two moments take 1.9 GB
_PREFIXES = {  # of the program's names → of ours; the nested blocks first
    "lidar_encoder.blocks.0.blocks.": "autoencoder.encoder.blocks.",
    "lidar_encoder.": "autoencoder.encoder.",
    "pre_quant.": "autoencoder.pre_quant.",
    "vector_quantizer.": "autoencoder.quantiser.",
    "lidar_decoder.blocks.blocks.": "autoencoder.decoder.blocks.",
    "lidar_decoder.": "autoencoder.decoder.",
    "maskgit_transformer.blocks.blocks.": "prior.blocks.",
    "maskgit_transformer.": "prior.",
}
_TABLES = re.compile(  # what follows from the sizes, or only training uses
    r".*\.(pos_embed|attn_mask|relative_position_index)|vector_quantizer\.(?!embedding\.).*|code_(age|usage)"
)
_POSITIONS = "lidar_encoder.pos_embed"


def read_ultralidar_checkpoint(
    path: Path, sizes: VoxelAutoencoderConfig
) -> tuple[VoxelAutoencoderConfig, SwinConfig, dict[str, Tensor]]:
    """Read the sizes of both stages, and the weights under our names; no network is built, and no code is run.

    Args:
        sizes: cells of the model, which the file does not tell.
    """
    with refused_as(path, "a checkpoint of UltraLiDAR's program"):
        file = read_everything(path, _BYTES_AT_MOST)
        if not isinstance(file, dict) or not isinstance(file.get("state_dict"), dict):
            raise RefusedFileError("which holds no 'state_dict'")
        found = {str(name): of for name, of in file["state_dict"].items()}
        weights = float_tensors({of_ours(n): t for n, t in found.items() if not _TABLES.fullmatch(n)}, _BYTES_AT_MOST)
        patches = _weight(weights, "autoencoder.encoder.patch_embed.proj.weight", 4)
        codes = _weight(weights, "autoencoder.quantiser.embedding.weight", 2)
        autoencoder = replace(
            sizes,
            patch=patches.shape[2],
            blocks=_blocks(weights, "autoencoder.encoder"),
            num_codes=codes.shape[0],
            code_dim=codes.shape[1],
        )
        positions, tokens = found.get(_POSITIONS), autoencoder.tokens[0] * autoencoder.tokens[1]
        cells = (tokens, sizes.grid.cells[2])
        theirs = (positions.shape[1] if isinstance(positions, Tensor) and positions.ndim == 3 else 0, patches.shape[1])
        if theirs != cells:
            raise CheckpointError(
                f"{path} for {theirs[0]} tokens of {theirs[1]} layers of cells",
                f"{cells[0]} tokens of {cells[1]} layers, as model.autoencoder.grid says",
                "set model.autoencoder.grid.cells to those of the file",
            )
        return autoencoder, _blocks(weights, "prior"), weights


def of_ours(name: str) -> str:
    """Return our name of one of the program's weights."""
    for theirs, ours in _PREFIXES.items():
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    return name


def _blocks(weights: dict[str, Tensor], network: str) -> SwinConfig:
    numbers = {int(found[1]) for name in weights if (found := re.match(rf"{network}\.blocks\.(\d{{1,6}})\.", name))}
    table = _weight(weights, f"{network}.blocks.0.attn.relative_position_bias_table", 2)
    width = len(_weight(weights, f"{network}.norm.0.weight", 1))
    return SwinConfig(width, table.shape[1], len(numbers))


def _weight(weights: dict[str, Tensor], name: str, axes: int) -> Tensor:
    if name not in weights or weights[name].ndim != axes:
        raise RefusedFileError(f"which holds no {name!r}")
    return weights[name]
