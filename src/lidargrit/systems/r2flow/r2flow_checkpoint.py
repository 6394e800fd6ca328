"""A checkpoint of R2Flow's authors, as their program has written it → sizes, settings and weights of the network.

Such a file is a dictionary written by torch.save, of which ``weights`` (moving average) and ``cfg`` (settings in the
parts ``data``, ``model``, ``flow``, ``training`` and, since the release of the training code, ``finetuning``) are read.

Source:
    kazuto1011/r2flow (MIT): r2flow/utils/inference.py at 78224ae for files without ``finetuning``, train.py and
    r2flow/utils/option.py at 819d7d3 for files with it.
"""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from lidargrit.core.errors import CheckpointError
from lidargrit.nn.published import RefusedFileError, float_tensors, read_everything, refused_as
from lidargrit.scans.sensors import SensorModel
from lidargrit.systems.r2flow.hdit import HditConfig

_BYTES_AT_MOST = 1 << 31  # the published network with the optimiser's state takes 1 GB
_WANTED = "a checkpoint of R2Flow's authors or of their train.py"
_CURE = "check which program saved it, or download it from kazuto1011/r2flow, its releases"


def read_r2flow_checkpoint(path: Path, sensor: SensorModel) -> tuple[HditConfig, int, int, dict[str, Tensor]]:
    """Read a checkpoint; no network is built, and no code in the file is run.

    Args:
        sensor: sensor whose limits the ranges of the images must have.

    Returns:
        sizes of the network; number of channels of an image; number of equal steps that the flow was distilled to, 0 if
        it was not; and the moving average of the weights, under the names of lidargrit.systems.r2flow.hdit.
    """
    with refused_as(path, _WANTED, _CURE):
        file = read_everything(path, _BYTES_AT_MOST)
        if not isinstance(file, dict) or "weights" not in file:
            raise RefusedFileError("which holds no 'weights'")
        steps = _distilled_steps(path, file.get("cfg"), sensor)
        weights = float_tensors(file["weights"], _BYTES_AT_MOST)
        hdit, channels = _sizes(weights)
    return hdit, channels, steps, weights


def _distilled_steps(path: Path, settings: Any, sensor: SensorModel) -> int:
    """Check what the settings say of the images, and return the number of steps that the flow was distilled to."""
    data, finetuning = _part(settings, "data"), _part(settings, "finetuning")
    known = {"data_format": "logscale", "min_depth": sensor.range_min_m, "max_depth": sensor.range_max_m}
    for name, wanted in known.items():
        if name in data and data[name] != wanted:
            got = f"{path} with data.{name}={str(data[name])[:40]}"
            raise CheckpointError(got, f"data.{name}={wanted}", "use other weights, or a sensor of these limits")
    steps = finetuning.get("k_distil")
    if steps is not None and (type(steps) is not int or steps < 1):
        raise CheckpointError(f"{path} with finetuning.k_distil={str(steps)[:40]}", "a number of steps", _CURE)
    return steps or 0


def _part(settings: Any, name: str) -> Mapping[str, Any]:
    part = settings.get(name) if isinstance(settings, dict) else None
    return part if isinstance(part, dict) else {}


def _sizes(weights: dict[str, Tensor]) -> tuple[HditConfig, int]:
    """Return the network's sizes and the number of its images' channels, as the shapes of its weights tell them."""
    channels, images, *_ = weights["tokenizer.0.weight"].shape
    time_channels = len(weights["timestep_pe.0.linear.weight"])
    halvings = next(n for n in itertools.count() if f"down_levels.merge_{n}.1.weight" not in weights)
    depths, heads = [], []
    for name in (*(f"down_levels.level_{level}" for level in range(halvings)), "mid_levels"):
        scales = [f"{name}.{block}.residual_attn.scale" for block in range(len(weights))]
        depths.append(next(block for block, scale in enumerate(scales) if scale not in weights))
        heads.append(len(weights[scales[0]]))
    return HditConfig(channels, time_channels, tuple(depths), tuple(heads)), images
