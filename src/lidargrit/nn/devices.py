"""The name of a device, such as "cpu" or "cuda:1" → the device, if it exists."""

import torch

from lidargrit.core.errors import ConfigError


def usable_device(name: str) -> torch.device:
    """Return a device by its name, such as "cpu" or "cuda"; with "", a GPU if there is one, and else the CPU."""
    name = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # "meta" has shapes and no numbers
    except (RuntimeError, AssertionError, NotImplementedError):  # an assertion: PyTorch was built without it
        other = "cpu or cuda" if torch.cuda.is_available() else "cpu"
        cure = f"try {other}; lidargrit doctor shows what there is"
        raise ConfigError(f"device {name!r}", "one that PyTorch finds on this computer", cure) from None
    return device
