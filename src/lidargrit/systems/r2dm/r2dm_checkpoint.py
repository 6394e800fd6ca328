"""A checkpoint of R2DM's authors, in either layout that their program has written → sizes and weights of the U-Net.

Such a file is a dictionary written by torch.save, of which ``cfg`` (settings) and ``ema_weights`` are read. In files of
the release 'weights' (r2dm-h-kitti360-300k.pth and the like) all settings are in one level, and names of weights
begin with ``denoiser.``. Since March 2024 the program writes the settings in the parts ``data``, ``model``,
``diffusion`` and ``training``, and names begin with ``model.``. What follows is the same in both.

Source:
    kazuto1011/r2dm (MIT): utils/inference.py and utils/training.py at 1c5963d for the first layout, train.py and
    utils/option.py at 6ce7cc2 for the second.
"""

from pathlib import Path
from typing import Any

from torch import Tensor

from lidargrit.core.errors import CheckpointError
from lidargrit.nn.published import RefusedFileError, float_tensors, read_everything, refused_as
from lidargrit.systems.r2dm.unet import UnetConfig

_BYTES_AT_MOST = 1 << 30  # the published files, with optimiser and average, take half a gigabyte
_WANTED = "a checkpoint of R2DM's authors or of their train.py"
_CURE = "check which program saved it, or download it from kazuto1011/r2dm, release 'weights'"
_PREFIXES = ("denoiser", "model")
_CONSTANTS = ("scale", "kernel", "freqs", "phase")  # buffers that lidargrit.systems.r2dm.unet builds by itself
_KNOWN_FORM: dict[str, Any] = {
    "data.depth_format": "log_depth",
    "data.train_depth": True,
    "model.architecture": "efficient_unet",
    "model.temb_channels": None,
    "model.gn_eps": 1e-6,
    "model.coords_encoding": "fourier_features",
    "diffusion.prediction_type": "eps",
    "diffusion.noise_schedule": "cosine",
    "diffusion.timestep_type": "continuous",
}
_FIRST_NAMES = {  # names of the second layout → those of the first, where the dot has not just been an underscore
    "data.depth_format": "image_format",
    "data.train_depth": "train_depth",
    "data.train_reflectance": "train_reflectance",
    "model.architecture": "model_name",
    "model.coords_encoding": "model_coords_embedding",
    "diffusion.prediction_type": "diffusion_objective",
    "diffusion.noise_schedule": "diffusion_beta_schedule",
    "diffusion.timestep_type": "diffusion_timesteps_type",
}


def read_r2dm_checkpoint(path: Path) -> tuple[UnetConfig, bool, dict[str, Tensor]]:
    """Read a checkpoint; no network is built, and no code in the file is run.

    Only the published form is known: log range, predicted noise, cosine schedule, continuous time, Fourier features.

    Returns:
        sizes of the network; whether it generates reflectance beside the range; and the moving average of the weights,
        under the names of lidargrit.systems.r2dm.unet.
    """
    with refused_as(path, _WANTED, _CURE):
        file = read_everything(path, _BYTES_AT_MOST)
        if not isinstance(file, dict):
            raise RefusedFileError("which holds no values by name")
        if not isinstance(file["cfg"], dict):
            raise RefusedFileError("whose settings have no names")
        settings = _Settings(file["cfg"])
        for name, required in _KNOWN_FORM.items():
            if name in settings and settings[name] != required:
                full_name = settings.name_in_file(name)
                got, wanted = f"{full_name}={settings[name]!r}", f"{full_name}={required!r}"
                raise CheckpointError(f"{path} with {got:.200}", wanted, "use other weights")
        unet = UnetConfig(
            channels=int(settings["model.base_channels"]),
            channel_multipliers=_four(settings["model.channel_multiplier"]),
            residual_blocks=_four(settings["model.num_residual_blocks"]),
            norm_groups=int(settings["model.gn_num_groups"]),
            attention_heads=int(settings["model.attn_num_heads"]),
        )
        weights = {
            name.partition(".")[2]: tensor
            for name, tensor in file["ema_weights"].items()
            if name.partition(".")[0] in _PREFIXES and name.rpartition(".")[2] not in _CONSTANTS
        }
        weights = float_tensors(weights, _BYTES_AT_MOST)
        reflectance = bool(settings["data.train_reflectance"]) if "data.train_reflectance" in settings else True
    _check_sizes(path, unet, weights)
    return unet, reflectance, weights


def _check_sizes(path: Path, unet: UnetConfig, weights: dict[str, Tensor]) -> None:
    """Refuse settings that are not those of the weights, before a network of any size is built from them."""
    for level, (multiplier, blocks) in enumerate(zip(unet.channel_multipliers, unet.residual_blocks, strict=True), 1):
        name, width = f"d_block{level}.residual_blocks.{blocks - 1}.conv1.weight", unet.channels * multiplier
        if name not in weights or weights[name].shape[:1] != (width,):
            raise CheckpointError(
                f"{path}, whose level {level} is not of {blocks} blocks with {width} channels, as its settings say",
                _WANTED,
                "check which program saved it",
            )


class _Settings:
    """Settings of a checkpoint in either layout, by the names of the second, such as ``model.base_channels``."""

    def __init__(self, found: dict[str, Any]) -> None:
        parts = {part: found[part] for part in ("data", "model", "diffusion") if part in found}
        nested = {f"{part}.{name}": value for part, of in parts.items() for name, value in of.items()}
        self._has_parts, self._by_name = bool(parts), nested or dict(found)

    def __contains__(self, name: str) -> bool:
        return self.name_in_file(name) in self._by_name

    def __getitem__(self, name: str) -> Any:
        return self._by_name[self.name_in_file(name)]

    def name_in_file(self, name: str) -> str:
        return name if self._has_parts else _FIRST_NAMES.get(name, name.replace(".", "_"))


def _four(setting: Any) -> tuple[int, ...]:
    """Return a setting that is one number for all four levels, or one for each level."""
    return (int(setting),) * 4 if isinstance(setting, int) else tuple(int(each) for each in setting)
