"""The main job from end to end: scans → range images → two trained networks → new scans → scores → pictures."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch

from lidargrit.datasets import open_dataset
from lidargrit.evaluation.samples import read_samples, write_samples
from lidargrit.evaluation.score import as_json, as_table, evaluate, score_reconstruction
from lidargrit.files import write_json
from lidargrit.generators import SamplingConfig
from lidargrit.generators.lidargrit import LidarGrit
from lidargrit.loading import RangeImages, load_range_images
from lidargrit.recipes import load_recipe
from lidargrit.reporting import Reporter
from lidargrit.training import train
from lidargrit.viewer import draw_comparison

_NUM_SAMPLES = 16
_MAX_SCANS = 400  # of the user's: more would not be seen in the demo's few minutes


def demo(data: str | None, folder: Path, settings: list[str], reporter: Reporter) -> Path:
    """Run everything on simulated or on the user's scans, and return the folder of the results.

    Args:
        data: a folder of scans or another source; simulated scans if not given.
        folder: becomes a run folder with ``samples``, ``evaluation.json`` and two pictures besides.
        settings: of the recipe, as ``--set`` takes them.
        reporter: hears of the progress.
    """
    sources = [] if data is None else split_sources(data, reporter)
    recipe = load_recipe("demo", [*sources, *settings])
    reporter.message("lidargrit demo: about 8 minutes on two cores; stop it at any time, the same command goes on")
    generator = train(recipe, folder, reporter)
    assert isinstance(generator, LidarGrit)
    val = load_range_images(recipe.data.val, recipe.data, reporter)
    real = load_range_images(recipe.data.train, recipe.data, reporter)
    seeds = range(_NUM_SAMPLES)
    write_samples(generator, folder, folder / "samples", seeds, SamplingConfig(), reporter=reporter)
    samples = read_samples(folder / "samples", _NUM_SAMPLES)
    reconstruction = score_reconstruction(generator.tokenizer, val)
    scores = evaluate(samples, real, ["sliced_wasserstein"])
    write_json(
        folder / "evaluation.json",
        {"reconstruction_on_val": asdict(reconstruction), "generated_against_train": as_json(scores)},
    )
    reporter.message(
        f"reconstruction of {reconstruction.num_scans} scans never trained on: range error "
        f"{reconstruction.range_mae_m:.2f} m, mask accuracy {reconstruction.mask_accuracy:.3f}, dropped rays found "
        f"{reconstruction.drop_recall:.2f} with precision {reconstruction.drop_precision:.2f}"
    )
    reporter.message(as_table(scores))
    reporter.message("(figures of a few minutes on little data; they do not compare with published tables)")
    _draw(generator, val, samples, folder)
    return folder


def split_sources(data: str, reporter: Reporter) -> list[str]:
    """Divide a user's scans into train and val, as settings: by whole drives where there are several.

    One drive in both would leak; where there is only one, its last scans are held out, and that is said.
    """
    dataset = open_dataset(data)
    drives = sorted({dataset.name(index).rpartition("/")[0] for index in range(len(dataset))})
    place = f"{dataset.public_name()}:{dataset.root}"
    has_drives = dataset.public_name() != "folder" and all(drive and "/" not in drive for drive in drives)
    if has_drives and len(drives) > 1 and dataset.split == "all":
        train, val = f"{place}:{'+'.join(drives[:-1])}", f"{place}:{drives[-1]}"
    else:
        reporter.message(
            "WARNING: one drive only: its last scans are held out, but they show the streets of the others"
        )
        train, val = f"{place}:{dataset.split}[:85%]", f"{place}:{dataset.split}[85%:]"
    return [
        f"data.train={train}",
        f"data.val={val}",
        f"data.sensor={dataset.sensor}",
        f"data.max_scans={_MAX_SCANS}",
    ]


def _draw(generator: LidarGrit, val: RangeImages, samples: RangeImages, folder: Path) -> None:
    real = val.batch([index * len(val) // 3 for index in range(3)])
    with torch.no_grad():
        reconstructed = generator.tokenizer.decode(generator.tokenizer.encode(real))
    title = "real scans never trained on, what the tokens keep of them, and new scans"
    draw_comparison(
        {"real": real, "reconstructed": reconstructed, "generated": samples.batch(range(3))},
        folder / "real_reconstructed_generated.png",
        title=title,
    )
    draw_comparison({"generated": samples.batch(range(3, 11))}, folder / "generated.png", title="generated scans")
