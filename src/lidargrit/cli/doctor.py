"""Tell what this machine has, and where lidargrit keeps its cache."""

from __future__ import annotations

import argparse

EXAMPLES = """\
  lidargrit doctor
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options: none."""


def run(options: argparse.Namespace) -> None:
    """Print facts that matter to a bug report or before a long run."""
    import os
    import platform
    import shutil
    from importlib.metadata import version

    import torch

    from lidargrit.loading import cache_folder
    from lidargrit.nn.precision import has_bf16

    existing = next(folder for folder in (cache_folder(), *cache_folder().parents) if folder.exists())
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    facts = {
        "lidargrit": version("lidargrit"),
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "lightning-fabric": version("lightning-fabric"),
        "processors": f"{os.cpu_count()}",
        "memory": f"{memory_gib:.1f} GiB",
        "bfloat16": "yes" if has_bf16() else "no: training takes two to three times as long in 32 bits",
        "cache": f"{cache_folder()}, {shutil.disk_usage(existing).free / 2**30:.1f} GiB free",
    }
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        facts[f"gpu {index}"] = f"{card.name}, {card.total_memory / 2**30:.0f} GiB"
    if not torch.cuda.is_available():
        facts["gpu"] = "none that torch can use: the small and demo recipes are made for this"
    for name, fact in facts.items():
        print(f"{name:<18}{fact}")
