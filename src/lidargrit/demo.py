"""The main job from end to end: scans → range images → two trained networks → new scans → scores → pictures."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from lidargrit.configuration import override
from lidargrit.datasets import open_dataset
from lidargrit.errors import DataError
from lidargrit.evaluation.comparison import Settings, compare_sides
from lidargrit.evaluation.samples import read_samples, write_samples
from lidargrit.evaluation.score import score_reconstruction
from lidargrit.evaluation.sides import Side, Sides
from lidargrit.files import write_json
from lidargrit.generators import Generator
from lidargrit.loading import DataConfig, RangeImages, load_range_images, spread
from lidargrit.recipes import load_recipe
from lidargrit.reporting import Reporter
from lidargrit.training import train
from lidargrit.viewer import draw_comparison

PICTURE = "scans_reconstructed_generated.png"
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
    recipe = load_recipe("demo")
    if data is not None:
        recipe = replace(recipe, data=divided(data, reporter))
    recipe = override(recipe, settings)
    reporter.message("lidargrit demo: about 9 minutes on two cores; stop it at any time, the same command goes on")
    generator = train(recipe, folder, reporter)
    val = load_range_images(recipe.data.val, recipe.data, reporter)
    real = load_range_images(recipe.data.train, recipe.data, reporter)
    seeds = range(_NUM_SAMPLES)
    write_samples(generator, folder, folder / "samples", seeds, reporter=reporter)
    samples = read_samples(folder / "samples", _NUM_SAMPLES)
    reconstruction = score_reconstruction(generator.get_tokenizer(), val)
    count = min(len(samples), len(real))
    sides = Sides(Side("samples", samples, range(count)), Side("train", real, spread(count, len(real))))
    card = compare_sides(sides, Settings(), reporter)
    write_json(
        folder / "evaluation.json",
        {"reconstruction_on_val": asdict(reconstruction), "generated_against_train": card.to_json()},
    )
    reporter.message(
        f"reconstruction of {reconstruction.num_scans} scans never trained on: range error "
        f"{reconstruction.range_mae_m:.2f} m, mask accuracy {reconstruction.mask_accuracy:.3f}, dropped rays found "
        f"{reconstruction.drop_recall:.2f} with precision {reconstruction.drop_precision:.2f}"
    )
    reporter.message(card.as_table())
    reporter.message("(figures of a few minutes on little data; they do not compare with published tables)")
    _draw(generator, "real" if data else "simulated", val, samples, folder)
    return folder


def divided(data: str, reporter: Reporter) -> DataConfig:
    """Divide a user's scans into train and val: by whole drives where there are several.

    One drive in both would leak; where there is only one, its last scans are held out, and that is said.

    Raises:
        DataError: too few scans to hold any out.
    """
    dataset = open_dataset(data)
    if len(dataset) < 4:
        raise DataError(f"{len(dataset)} scans in {data}", "at least 4, to hold one out", "add scans")
    place, split = f"{dataset.public_name()}:{dataset.root}", dataset.split
    drives = sorted({dataset.name(index).rpartition("/")[0] for index in range(len(dataset))})
    has_drives = dataset.public_name() != "folder" and all(drive and "/" not in drive for drive in drives)
    if has_drives and len(drives) > 1 and "[" not in split:
        train, val = f"{place}:{'+'.join(drives[:-1])}", f"{place}:{drives[-1]}"
    elif "[" in split:
        raise DataError(
            f"{data} with a share", "whole drives, or a folder", "leave the brackets out: demo divides the scans"
        )
    else:
        reporter.message(
            "WARNING: the last scans are held out; if they are of the same drive, they show the same streets"
        )
        train, val = f"{place}:{split}[:85%]", f"{place}:{split}[85%:]"
    return DataConfig(train=(train,), val=(val,), sensor=dataset.sensor, max_scans=_MAX_SCANS)


def _draw(generator: Generator, kind: str, val: RangeImages, samples: RangeImages, folder: Path) -> None:
    real = val.batch(spread(3, len(val)))
    title = f"{kind} scans never trained on, what the tokens keep of them, and new scans"
    draw_comparison(
        {kind: real, "reconstructed": generator.reconstruct(real), "generated": samples.batch(range(3))},
        folder / PICTURE,
        title=title,
    )
    draw_comparison({"generated": samples.batch(range(3, 11))}, folder / "generated.png", title="generated scans")
