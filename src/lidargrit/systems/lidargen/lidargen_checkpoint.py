"""A checkpoint of LiDARGen's authors → sizes, noise levels and weights of the score network.

Such a file is a list written by torch.save: weights under names that begin with ``module.``, state of the optimiser,
epoch, step, and the moving average of the weights, whose names have no such beginning.

Source:
    vzyrianov/lidargen@4c3226c (MIT), LiDARGen/runners/ncsn_runner.py.
"""

from pathlib import Path

import torch
from torch import Tensor

from lidargrit.nn.published import RefusedFileError, float_tensors, read_everything, refused_as
from lidargrit.systems.lidargen.score_matching import sigma_table

_BYTES_AT_MOST = 1 << 30  # weights, their average and the optimiser's two moments take half a gigabyte
_PARTS, _WEIGHTS, _AVERAGE = 5, 0, 4
_SIGMAS = "module.sigmas"


def read_lidargen_checkpoint(path: Path) -> tuple[int, int, Tensor, dict[str, Tensor]]:
    """Read a checkpoint; no network is built, and no code in the file is run.

    Returns:
        number of channels of the finest level, and of an image; noise levels, the largest first; and the moving average
        of the weights, under the names of lidargrit.systems.lidargen.ncsn.
    """
    with refused_as(path, "a checkpoint of LiDARGen's authors or of their program"):
        parts = read_everything(path, _BYTES_AT_MOST)
        if not isinstance(parts, (list, tuple)) or len(parts) != _PARTS:
            raise RefusedFileError(f"which holds no list of {_PARTS} parts")
        trained = parts[_WEIGHTS]
        if not isinstance(trained, dict) or _SIGMAS not in trained:
            raise RefusedFileError(f"which holds no {_SIGMAS!r}")
        sigmas = float_tensors({_SIGMAS: trained[_SIGMAS]}, _BYTES_AT_MOST)[_SIGMAS]
        weights = float_tensors(parts[_AVERAGE], _BYTES_AT_MOST)
        for name in ("begin_conv.weight", "end_conv.weight"):
            if name not in weights or weights[name].ndim != 4:
                raise RefusedFileError(f"whose moving average holds no convolution {name!r}")
        _refuse_other_levels(sigmas)
    return (len(weights["begin_conv.weight"]), len(weights["end_conv.weight"]), sigmas, weights)


def _refuse_other_levels(sigmas: Tensor) -> None:
    falling = sigmas.ndim == 1 and len(sigmas) > 1 and bool(sigmas[0] > sigmas[-1]) and bool(sigmas[-1] > 0)
    if not falling or not bool(sigmas.isfinite().all()):
        raise RefusedFileError(f"whose {_SIGMAS!r} are no falling noise levels")
    if not torch.allclose(sigmas, sigma_table(float(sigmas[0]), float(sigmas[-1]), len(sigmas)), rtol=1e-3, atol=0):
        raise RefusedFileError(f"whose {_SIGMAS!r} do not fall by one factor")
