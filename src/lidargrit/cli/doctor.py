"""Show what this machine has, and where lidargrit keeps its cache."""

import argparse

from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit doctor
  lidargrit doctor --json > machine.json            for a bug report
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    import os
    import platform
    import shutil
    from importlib.metadata import version

    import torch

    from lidargrit.core.environment import cache_folder
    from lidargrit.nn.precision import has_bf16

    refuse_taken(options)
    existing = next(folder for folder in (cache_folder(), *cache_folder().parents) if folder.exists())
    cards = [torch.cuda.get_device_properties(index) for index in range(torch.cuda.device_count())]
    facts = {
        "lidargrit": version("lidargrit"),
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "lightning_fabric": version("lightning-fabric"),
        "processors": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "bfloat16": has_bf16(),
        "cache": str(cache_folder()),
        "cache_free_gib": round(shutil.disk_usage(existing).free / 2**30, 1),
        "gpus": [{"name": card.name, "memory_gib": round(card.total_memory / 2**30)} for card in cards],
    }
    shown = {name.replace("_gib", "").replace("_", " "): fact for name, fact in facts.items()}
    shown |= {name: f"{shown[name]:.1f} GiB" for name in ("memory", "cache free")}
    shown["bfloat16"] = "yes" if has_bf16() else "no: training takes one and a half to two times as long in 32 bits"
    none = "none that torch can use; the presets lidargrit_small and lidargrit_demo are made for CPUs"
    shown["gpus"] = ", ".join(f"{card['name']}, {card['memory_gib']} GiB" for card in facts["gpus"]) or none
    print_result(options, "\n".join(f"{name:<18}{fact}" for name, fact in shown.items()), facts)
