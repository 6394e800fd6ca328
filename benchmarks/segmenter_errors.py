"""A segmenter and labelled scans → how sure it is where it is right, and one picture: found, true, errors of a scan.

    python benchmarks/segmenter_errors.py runs/mine kitti_odometry:/data/pandaset:001 pandaset errors.png

The table sorts the returns by the probability of the group of classes that was found: where a segmenter is calibrated,
as large a share of them is right. The last line is the expected calibration error (Naeini et al., AAAI 2015): the mean
distance of both, weighted by returns. Classes of no group do not count.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from lidargrit.core.table import Table
from lidargrit.data.sources import open_images
from lidargrit.generation.semantic_classes import NUM_CLASSES, labels_of
from lidargrit.inference.segment import class_probabilities, open_segmenter
from lidargrit.inference.segment.command import GROUP_OF_NUMBER, GROUPS
from lidargrit.scans.classes import as_semantic_kitti

_BINS = 10


def main() -> None:
    """Label, print the table, and plot the first scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run of a segmenter, or pretrained")
    parser.add_argument("scans", help="source of labelled scans")
    parser.add_argument("numbering", help="numbering of their labels: semantic_kitti, pandaset or nuscenes")
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    probability, right = list[Tensor](), list[Tensor]()
    for number, (of_group, true, returned) in enumerate(_labelled(options.run, options.scans, options.numbering)):
        if not number:
            _plot(of_group.argmax(0).where(returned, 0), true, options.picture)
        surest, found = of_group.max(0)
        counts = true > 0
        probability.append(surest[counts])
        right.append((found == true)[counts])
    print(_table(torch.cat(probability), torch.cat(right)))


def _labelled(run: str, scans: str, numbering: str) -> Iterator[tuple[Float[Tensor, "g H W"], Tensor, Tensor]]:
    """Yield the probability of each group of classes (0 is none), the true group, and where rays returned."""
    segmenter = open_segmenter(run)
    images = open_images(scans, segmenter.sensor.fine())
    group_of_class = GROUP_OF_NUMBER[labels_of(torch.arange(1, NUM_CLASSES + 1))]
    for index in range(len(images)):
        image = images.batch([index])
        assert image.label is not None, "scans with labels"
        of_class = class_probabilities(segmenter, image)[0]
        of_group = torch.zeros(len(GROUPS) + 1, *of_class.shape[1:]).index_add(0, group_of_class, of_class)
        returned = image.return_mask[0]
        true = GROUP_OF_NUMBER[as_semantic_kitti(image.label.where(image.return_mask, 0), numbering)[0].long()]
        yield of_group, true.where(returned, 0), returned


def _table(probability: Float[Tensor, " n"], right: Tensor) -> str:
    at = (probability * _BINS).long().clamp(max=_BINS - 1)
    count = torch.bincount(at, minlength=_BINS)
    sure, share = (torch.bincount(at, each.double(), _BINS) / count.clamp(min=1) for each in (probability, right))
    rows = tuple(
        (f"{n / count.sum():.3f}", f"{p:.3f}", f"{r:.3f}") for n, p, r in zip(count, sure, share, strict=True) if n
    )
    error = float(((sure - share).abs() * count).sum() / count.sum())
    mean = f"mean probability {probability.mean():.3f}, right {right.double().mean():.3f}"
    return Table(("share of returns", "mean probability", "right"), rows).as_text() + f"\n{mean}, error {error:.3f}"


def _plot(found: Int[Tensor, "H W"], true: Int[Tensor, "H W"], path: Path) -> None:
    colours = torch.tensor(colormaps["tab10"].colors)  # type: ignore[attr-defined]
    colours = torch.cat((torch.zeros(1, 3), colours))
    wrong = torch.where((true > 0)[..., None], torch.tensor([0.85, 0.85, 0.85]), torch.zeros(3))
    wrong[(found != true) & (true > 0)] = torch.tensor([0.8, 0.0, 0.0])
    figure = Figure(figsize=(16, 6), dpi=90)
    FigureCanvasAgg(figure)
    looks = ((colours[found], "found"), (colours[true], "true"), (wrong, "errors"))
    for axes, (look, name) in zip(figure.subplots(3, 1), looks, strict=True):
        axes.imshow(look.numpy(), aspect="auto", interpolation="none")
        axes.set(xticks=[], yticks=[], ylabel=name)
    for index, group in enumerate(GROUPS, 1):
        figure.text(0.1 + 0.1 * index, 0.05, group, color=colours[index].tolist())
    figure.savefig(path)


if __name__ == "__main__":
    main()
