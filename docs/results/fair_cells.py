"""Scores of one system at one budget, as ``keep_scores.py`` keeps them → the score of each metric; names of systems."""

import json
from pathlib import Path
from typing import Any

NAMES = {
    "small_pixels": "LidarGRIT with a pixel decoder",
    "small": "LidarGRIT",
    "multiscale_small": "pixel decoder without tokens",
    "maskgit_small": "MaskGIT",
    "dusty_small": "DUSty-I",
    "dusty2_small": "DUSty-II",
    "dcgan_small": "DCGAN",
    "lidargan_small": "LidarGAN",
    "lidarvae_small": "LidarGAN's VAE",
    "ultralidar_small": "UltraLiDAR",
    "r2dm_small.steps32": "R2DM, 32 steps",
    "r2flow_small.steps16": "R2Flow, 16 steps",
    "r2flow_reflow_small": "R2Flow, 1 step",
    "lidargen_small": "LiDARGen",
    "lidm_small": "LiDM",
    "lidm_small.latent_axes2": "LiDM, noise along two axes of its codes",
    "lidm_shared_small": "LiDM over LidarGRIT's tokens",
    "lidm_shared_small.all_channels": "LiDM over LidarGRIT's tokens, noise in all channels",
}
"""Systems that are trained, by the name of their file."""

_VARIANTS = ("exact", "textbook")  # of the default protocol, where a file has several of a metric


def read_cell(path: Path) -> dict[str, Any]:
    """Return the file with its scores by metric, one variant of each.

    Raises:
        SystemExit: a metric in several variants of which none is the default protocol's.
    """
    cell = json.loads(path.read_text(encoding="utf-8"))
    by_metric: dict[str, dict[str, Any]] = {}
    for score in cell["scores"]:
        by_metric.setdefault(score["metric"], {})[score["variant"]] = score
    chosen = {}
    for metric, variants in by_metric.items():
        wanted = [variants[name] for name in _VARIANTS if name in variants] or list(variants.values())
        if len(variants) > 1 and not variants.keys() & set(_VARIANTS):
            raise SystemExit(
                f"{path}: got {metric} as {', '.join(variants)}; wanted one of them; score it with --variant"
            )
        chosen[metric] = wanted[0]
    return cell | {"scores": chosen}


def short(value: float) -> str:
    """Return a score with three decimals, or two digits if it is smaller than they can tell."""
    return f"{value:.1e}".replace("e-0", "e-") if 0 < abs(value) < 0.0005 else f"{value:.3f}".removeprefix("0")


def rank_key(score: dict[str, Any]) -> float:
    """Return the value by which better scores come first."""
    return -score["value"] if score["higher_is_better"] else score["value"]
