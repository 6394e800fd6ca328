"""Errors of completion: whole scans with hidden parts → errors of the filled pixels."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.determinism import derive_seed, scan_seed
from lidargrit.core.errors import ConfigError, DataError, UsageError, counted_scans, no_usable_scan
from lidargrit.core.table import Table
from lidargrit.data.images import RangeImages
from lidargrit.evaluation.intervals import Estimate
from lidargrit.evaluation.metrics import load_metric
from lidargrit.generation.semantic_classes import NUM_CLASSES, class_indices, class_iou
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.scans.condition import Observed
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

PATTERNS = ("rows:4", "sector:45,315", "pixels:0.1")
"""Patterns that are compared unless others are named: every fourth row, all but 90 degrees ahead, a tenth."""
BASELINE = "triangulation"
VOXEL_M = 0.1
Measure = Callable[[RangeImage, RangeImage, Bool[Tensor, "H W"]], float]  # of two images, over hidden pixels
_HEAD = ("model", "MAE [m]", "MAE - triangulation [m]", "found", "IoU", "drop runs", "diversity [m]", "s/scan")
_WHERE_KNOWN = ("reflectance MAE", "class accuracy", "mIoU")


@dataclass(frozen=True)
class CompletionScore:
    """How well one model or classical method fills in one pattern.

    Only pixels that were not observed count, except in ``drop_run_lengths``; errors, ``found`` and ``iou`` are means
    over the completions of a scan, while ``drop_run_lengths`` and both scores of classes take the first alone.

    Args:
        model: name of the model or method, as the user typed it.
        observed: pattern of the observed pixels.
        mae_m: mean absolute error of the range, over pixels that return in both scans; lower is better.
        found: share of the true hidden returns where the completed scan has a return, too; ``mae_m`` covers only these.
        iou: intersection over union of the 0.1 m voxels that hold a point; higher is better.
        drop_run_lengths: distance between the distributions of the lengths of runs of drops in completed and true
            scans, over all pixels, those that were observed among them.
        diversity_m: mean absolute difference in metres between two completions of a scan, over pixels where both
            return; None for a single completion.
        seconds_per_scan: time in seconds that one completion took on this machine.
        beside_triangulation_m: difference of ``mae_m`` from that of triangulation on the same scans; negative if
            better.
        class_accuracy: share of right classes, over the pixels of ``mae_m`` whose true class is one of the 19 of
            SemanticKITTI's benchmark; None where the true scans have no labels.
        class_iou: mean over the classes that these pixels hold, all scans together, of intersection over union.
        reflectance_error: mean absolute error of reflectance, over the pixels of ``mae_m``; None where the true scans
            have none.
    """

    model: str
    observed: str
    num_scans: int
    mae_m: Estimate
    found: Estimate
    iou: Estimate
    drop_run_lengths: float
    diversity_m: Estimate | None
    seconds_per_scan: float
    beside_triangulation_m: Estimate | None = None
    class_accuracy: Estimate | None = None
    class_iou: float | None = None
    reflectance_error: Estimate | None = None


def compare_completion(
    images: RangeImages,
    models: Sequence[Model],
    patterns: Sequence[Pattern],
    completions: int = 2,
    seed: int = 0,
    skips: bool = False,
) -> list[CompletionScore]:
    """Hide parts of scans, have every model fill them in, and compare.

    Args:
        models: models and classical methods, of the sensor of the images.
        patterns: choices of the observed pixels; each scan has its own random pixels, the same for all models.
        completions: number of completions of each scan by a model that is random.
        seed: seed of the first completion, and of the random pixels.
        skips: whether scans of which a pattern observes nothing, or all, are left out of its scores, with a message.

    Returns:
        scores of all models by the first pattern, then by the next.
    """
    if not len(images) or completions < 1:
        raise DataError(
            f"{counted_scans(len(images))}, {completions} completions of each", "at least 1 of both", "raise the number"
        )
    for model in models:
        _check(model, images)
    whole, names = images.batch(range(len(images))), images.provenance.names
    scores = []
    with reporting.progress("completing", len(patterns) * len(models)) as progress:
        for pattern in patterns:
            masks = dict[int, Tensor]()
            for at, name in enumerate(names):
                with leaving_out(skips):
                    masks[at] = pattern.mask(whole[at], derive_seed(seed, at), name)
            if not masks:
                raise no_usable_scan(f"those that --observed {pattern.text} is to observe")
            some, observed = whole[[*masks]], torch.stack([*masks.values()])
            if not bool((some.return_mask.cpu() & ~observed).any()):
                got = f"--observed {pattern.text}, which hides no return of these scans"
                raise UsageError(got, "pixels that leave some returns out", "observe others, as rows:4")
            condition = Observed.of_pixels(some, observed)
            seeds = [[scan_seed(seed + turn, at) for at in masks] for turn in range(completions)]
            of_pattern = []
            for model in models:
                of_pattern.append(_score(model, pattern, some, condition, seeds))
                progress.advance(1, model.name)
            scores += _beside(of_pattern)
    return scores


def tables(scores: Sequence[CompletionScore]) -> list[Table]:
    """Return a table for each pattern."""
    found = []
    for pattern in dict.fromkeys(score.observed for score in scores):
        rows = tuple(_row(score) for score in scores if score.observed == pattern)
        table = Table((*_HEAD, *_WHERE_KNOWN), rows, f"observed: {pattern}")
        found.append(table.without_empty(*_WHERE_KNOWN))
    return found


def _row(score: CompletionScore) -> tuple[str, ...]:
    beside, diversity, error = score.beside_triangulation_m, score.diversity_m, score.reflectance_error
    return (
        score.model,
        score.mae_m.as_text(".3f"),
        "" if beside is None else beside.as_text("+.3f"),
        f"{score.found.value:.3f}",
        f"{score.iou.value:.3f}",
        f"{score.drop_run_lengths:.4f}",
        "" if diversity is None else f"{diversity.value:.3f}",
        f"{score.seconds_per_scan:.3f}",
        "" if error is None else error.as_text(".4f"),
        "" if score.class_accuracy is None else f"{score.class_accuracy.value:.3f}",
        "" if score.class_iou is None else f"{score.class_iou:.3f}",
    )


def _check(model: Model, images: RangeImages) -> None:
    if not model.sensor.same_rays(images.sensor):
        raise ConfigError(
            f"the model {model.name} of {model.sensor.name!r}",
            f"one of {images.sensor.name!r}, {images.sensor.height}x{images.sensor.width}, as the first",
            "compare models of one sensor",
        )
    if shared := model.learned_from().overlap(images.provenance):
        reporting.message(f"WARNING: {model.name} and the scans overlap ({shared}): the scores flatter it")


def _score(
    model: Model, pattern: Pattern, whole: RangeImage, condition: Observed, seeds: Sequence[list[int]]
) -> tuple[CompletionScore, list[float]]:
    """Return how well a model fills in a pattern, and its mean absolute error of each scan in metres.

    Args:
        seeds: seeds of all scans for each completion; the first alone are of a model that is not random.
    """
    turns = len(seeds) if model.generator.is_random else 1
    begin = time.perf_counter()
    filled = [model.complete(condition, of_turn) for of_turn in seeds[:turns]]
    seconds = (time.perf_counter() - begin) / (len(whole) * turns)
    hidden = ~condition.return_observed

    def each(measure: Measure, pairs: Sequence[tuple[RangeImage, RangeImage]]) -> list[float]:
        """Return the mean over pairs of batches of what is measured of each scan."""
        return [_mean([measure(one[i], other[i], hidden[i]) for one, other in pairs]) for i in range(len(whole))]

    with_truth = [(images, whole) for images in filled]
    errors, of_reflectance = each(_error_m, with_truth), each(_reflectance_error, with_truth)
    apart = each(_error_m, [*combinations(filled, 2)])
    classes = [_confusion(filled[0][i], whole[i], hidden[i]) for i in range(len(whole))]
    confusions = [one for one in classes if one is not None]
    bright = whole.reflectance is not None and filled[0].reflectance is not None
    runs = load_metric("drop_run_lengths")()
    runs.update(filled[0], real=False)
    runs.update(whole, real=True)
    score = CompletionScore(
        model.name,
        pattern.text,
        len(whole),
        Estimate.of(errors),
        Estimate.of(each(_found, with_truth)),
        Estimate.of(each(_iou, with_truth)),
        runs.compute().value,
        Estimate.of(apart) if turns > 1 else None,
        seconds,
        class_accuracy=Estimate.of([_accuracy(one) for one in confusions]) if confusions else None,
        class_iou=_mean_iou(torch.stack(confusions).sum(0)) if confusions else None,
        reflectance_error=Estimate.of(of_reflectance) if bright else None,
    )
    return score, errors


def _beside(scores: Sequence[tuple[CompletionScore, list[float]]]) -> list[CompletionScore]:
    """Add to the scores of one pattern their differences from triangulation's, if that is among them."""
    base = next((errors_m for score, errors_m in scores if score.model == BASELINE), None)
    if base is None:
        return [score for score, _ in scores]
    apart = [Estimate.of([own - its for own, its in zip(errors_m, base, strict=True)]) for _, errors_m in scores]
    return [
        score if score.model == BASELINE else replace(score, beside_triangulation_m=difference)
        for (score, _), difference in zip(scores, apart, strict=True)
    ]


def _error_m(one: RangeImage, other: RangeImage, hidden: Bool[Tensor, "H W"]) -> float:
    return _mean_error(one.range_m, other.range_m, hidden & one.return_mask & other.return_mask)


def _reflectance_error(one: RangeImage, other: RangeImage, hidden: Bool[Tensor, "H W"]) -> float:
    if one.reflectance is None or other.reflectance is None:
        return math.nan
    return _mean_error(one.reflectance, other.reflectance, hidden & one.return_mask & other.return_mask)


def _mean_error(one: Float[Tensor, "H W"], other: Float[Tensor, "H W"], both: Bool[Tensor, "H W"]) -> float:
    return float((one - other)[both].double().abs().mean()) if bool(both.any()) else math.nan


def _found(filled: RangeImage, true: RangeImage, hidden: Bool[Tensor, "H W"]) -> float:
    wanted = hidden & true.return_mask
    return float(filled.return_mask[wanted].double().mean()) if bool(wanted.any()) else math.nan


def _iou(filled: RangeImage, true: RangeImage, hidden: Bool[Tensor, "H W"]) -> float:
    """Return the intersection over union of the voxels with a point, of hidden pixels alone."""
    ours, theirs = (_voxels(points_of_pixels(image)[image.return_mask & hidden]) for image in (filled, true))
    union = len(ours | theirs)
    return len(ours & theirs) / union if union else math.nan


def _confusion(filled: RangeImage, true: RangeImage, hidden: Bool[Tensor, "H W"]) -> Int[Tensor, "20 20"] | None:
    """Return how many hidden pixels that return in both have a true class (row) and a filled one; None without labels.

    The first row and column stand for labels of no class.
    """
    if filled.label is None or true.label is None:
        return None
    both = hidden & filled.return_mask & true.return_mask
    pairs = class_indices(true.label[both]) * (NUM_CLASSES + 1) + class_indices(filled.label[both])
    return pairs.bincount(minlength=(NUM_CLASSES + 1) ** 2).view(NUM_CLASSES + 1, NUM_CLASSES + 1)


def _accuracy(confusion: Int[Tensor, "20 20"]) -> float:
    known = int(confusion[1:].sum())
    return int(confusion.diagonal()[1:].sum()) / known if known else math.nan


def _mean_iou(confusion: Int[Tensor, "20 20"]) -> float:
    iou = class_iou(confusion).double()
    return float(iou[~iou.isnan()].mean())


def _voxels(points_xyz_m: Float[Tensor, "n 3"]) -> set[tuple[int, int, int]]:
    return {(x, y, z) for x, y, z in (points_xyz_m.double() / VOXEL_M).floor().long().unique(dim=0).tolist()}


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if not math.isnan(value)]
    return sum(finite) / len(finite) if finite else math.nan
