"""(generator, seeds) → a folder of generated scans, one a file; data/sources/samples.py reads it."""

import json
import os
from collections.abc import Sequence
from contextlib import nullcontext
from functools import lru_cache, partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidargrit.core import configuration, reporting
from lidargrit.core.files import (
    atomic_path,
    claim_folder,
    read_json,
    remove_partials,
    removed_meanwhile,
    write_json,
    write_text,
)
from lidargrit.core.shares import each_done
from lidargrit.data.run_folder import TRAINED_ON_FILE, recorded_projection, trained_on_file, weights_sha256
from lidargrit.data.scan_folder import begun_by
from lidargrit.data.sources.samples import MANIFEST, is_sample_folder
from lidargrit.generation.generator import Generator, SamplingT, load
from lidargrit.scans.types import RangeImage

_SHARE_ON_RAY = 32  # seeds: two batches, seconds of work


def write_samples(
    generator: Generator[Any, SamplingT],
    run_folder: Path,
    folder: Path,
    seeds: Sequence[int],
    sampling: SamplingT | None = None,
) -> None:
    """Write one file for each seed, at bounded memory; seeds that are there already are not sampled again.

    Args:
        run_folder: folder that the generator was read from; the hash of its weights identifies the samples.
        folder: output folder for ``samples.json`` and ``SEED.npz`` with ``range_m`` (H, W) in metres, 0 for no return,
            and ``reflectance`` in [0, 1] if the generator writes it.
        seeds: one seed for each scan; other processes may write other seeds into the same folder meanwhile.
    """
    settings = generator.Sampling() if sampling is None else sampling
    manifest: dict[str, Any] = {
        **sampling_identity(generator, run_folder, settings),
        "generator": generator.public_name(),
        "sensor": generator.sensor.to_json(),
    }
    if variant := recorded_projection(run_folder):
        manifest["projection_variant"] = variant
    if generator.full_rows is not None:
        manifest["full_rows"] = [generator.full_rows.start, generator.full_rows.stop]
    trained_on = _trained_on(run_folder)
    begun = _is_begun(folder, manifest)
    missing = _missing(folder, seeds)
    images = generator.stream(missing, settings)
    with (
        claim_folder(folder, shared=True) if missing else nullcontext(),
        reporting.progress("sampling", len(seeds), len(seeds) - len(missing)) as progress,
    ):
        first = list(islice(images, 1))  # what the model refuses is told before anything is written
        if missing and not begun:
            _begin(folder, manifest)
        if trained_on is not None and not (folder / TRAINED_ON_FILE).exists() and is_sample_folder(folder):
            write_text(folder / TRAINED_ON_FILE, trained_on)
        for seed, image in zip(missing, chain(first, images), strict=True):
            if not is_sample_folder(folder):  # or the write would make the folder anew, without the earlier samples
                raise removed_meanwhile(folder)
            _write_image(_file(folder, seed), image)
            progress.advance(1)
    if seeds and (not is_sample_folder(folder) or _missing(folder, seeds)):
        raise removed_meanwhile(folder)
    remove_partials(folder)


def write_samples_on_ray(
    run_folder: Path, folder: Path, seeds: Sequence[int], words: Sequence[str], ray: str, device: str = ""
) -> None:
    """Let a Ray cluster write the samples of :func:`write_samples`, on its GPUs where it has some.

    Args:
        run_folder: folder of the generator, and ``folder`` of the samples: all machines see both at these paths.
        words: settings of sampling, as ``temperature=1.1``.
        ray: address of the cluster; see :func:`each_done`.
        device: device of each task; its GPU, or its CPU where the cluster has none, if not given.
    """
    shares = [seeds[first : first + _SHARE_ON_RAY] for first in range(0, len(seeds), _SHARE_ON_RAY)]
    do = partial(_write_some, run_folder, folder, words, device)
    with reporting.progress("sampling", len(seeds)) as progress:
        for count in each_done(do, shares, ray=ray, on_gpus=device != "cpu"):
            progress.advance(count)


def _write_some(run_folder: Path, folder: Path, words: Sequence[str], device: str, seeds: Sequence[int]) -> int:
    generator = _generator_of(run_folder, device or ("cuda" if torch.cuda.is_available() else "cpu"))
    write_samples(generator, run_folder, folder, seeds, generator.parse_sampling(words))
    return len(seeds)


@lru_cache(maxsize=1)  # for all shares of a worker
def _generator_of(run_folder: Path, device: str) -> Generator[Any, Any]:
    return load(run_folder, device=device)


def sampling_identity(generator: Generator[Any, Any], run_folder: Path, sampling: object) -> dict[str, Any]:
    """Return what decides, beside the seed, which scan is sampled: the weights, the configuration and the settings."""
    return {
        "weights_sha256": weights_sha256(run_folder),
        "config": configuration.to_json(generator.config),
        "sampling": configuration.to_json(sampling),
    }


def _is_begun(folder: Path, manifest: dict[str, Any]) -> bool:
    """Return whether a folder holds samples of the same kind; False for a free one, others are refused."""
    other = "which holds samples of another model or sampled in another way"
    return begun_by(folder / MANIFEST, lambda there: "" if _same(there, manifest) else other) is not None


def _begin(folder: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest into a free folder, unless another process has written it meanwhile."""
    if not _is_begun(folder, manifest):
        write_json(folder / MANIFEST, manifest)


def _trained_on(run_folder: Path) -> str | None:
    """Return what the model learned from, as it is to lie beside its samples; None where the run does not tell."""
    source = trained_on_file(run_folder)
    return None if source is None else json.dumps(read_json(source), separators=(",", ":")) + "\n"


def _missing(folder: Path, seeds: Sequence[int]) -> list[int]:
    there = {entry.name for entry in os.scandir(folder)} if folder.exists() else set[str]()
    return [seed for seed in seeds if _file(folder, seed).name not in there]


def _same(there: dict[str, Any], manifest: dict[str, Any]) -> bool:
    """Return whether samples there were sampled as these will be."""
    return {name: value for name, value in there.items() if name != "cost_per_scan"} == manifest  # of earlier versions


def _write_image(path: Path, image: RangeImage) -> None:
    pixels: dict[str, Any] = {"range_m": image.range_m.cpu().numpy()}
    if image.reflectance is not None:
        pixels["reflectance"] = image.reflectance.cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **pixels)


def _file(folder: Path, seed: int) -> Path:
    return folder / f"{seed:08d}.npz"
