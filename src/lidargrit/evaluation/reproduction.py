"""A table of the paper and a folder of scans → its systems, what they have in common, and what they cost."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lidargrit.core.errors import ConfigError
from lidargrit.data.run_folder import is_run
from lidargrit.data.sources import load_range_images, open_source
from lidargrit.evaluation.compare import CompareConfig
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.training import computing_time, plan_training

SIMULATED = "simulated"  # in place of a root
_SIMULATED_SCANS = {"train": 300, "val": 16}  # the demo's: a few minutes of simulating
_SMALL_FLOPS, _SMALL_COUNT = 5e13, 64  # some minutes of two cores for each system


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper.

    Args:
        train: split to train on; it shares no drive with ``val`` and ``test``, the splits of these names.
        images: settings that make the protocol's images of the data set's scans.
        small_images: settings that make images with fewer columns.
        rows: presets of each row of the paper, by the row's name: one of the paper's size, and a small one.
        remarks: sentences that a reader of the measured rows must know.
    """

    title: str
    protocol: str
    data_set: str
    train: str
    rows: Mapping[str, tuple[str, str]]
    images: tuple[str, ...] = ()
    small_images: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


_KITTI_360_IMAGES = ("data.sensor=hdl64e_kitti_360", "data.columns=2048", "data.column_stride=2")

TABLES = {
    1: PaperTable(
        "systems on KITTI-360",
        "lidargrit_kitti_360",
        "kitti_360",
        "train_without_val",
        {
            "LiDARGen": ("lidargen_kitti_360", "lidargen_small"),
            "UltraLiDAR (unofficial program)": ("ultralidar_kitti_360", "ultralidar_small"),
            "R2DM": ("r2dm_kitti_360", "r2dm_small"),
            "LidarGRIT": ("lidargrit_kitti_360", "lidargrit_small"),
        },
        _KITTI_360_IMAGES,
        (*_KITTI_360_IMAGES[:2], "data.column_stride=8"),
        remarks=(
            "R2DM learns here from the images that it is scored against; the paper's were projected otherwise",
            "all scores of UltraLiDAR measure the cells of its voxels too; the paper has no SWD and FPD of it",
        ),
    ),
    2: PaperTable(
        "systems on KITTI odometry",
        "lidargrit_kitti_odometry",
        "kitti_odometry",
        "train",
        {
            "LidarGAN": ("lidargan_kitti_odometry", "lidargan_small"),
            "DUSty": ("dusty_kitti_odometry", "dusty_small"),
            "LidarGRIT": ("lidargrit_kitti_odometry", "lidargrit_small"),
        },
        remarks=(
            "LidarGAN generates 40 of the 64 rows, without raydrop, as published; how the paper made its own row "
            "is not known. The plain GAN beneath DUSty (model.variant=baseline) generates all rows",
        ),
    ),
    3: PaperTable(
        "ablation on KITTI odometry",
        "lidargrit_kitti_odometry",
        "kitti_odometry",
        "train",
        {
            "without geometric preservation and raydrop loss": (
                "lidargrit_kitti_odometry_neither",
                "lidargrit_small_neither",
            ),
            "with raydrop loss": ("lidargrit_kitti_odometry_raydrop", "lidargrit_small_raydrop"),
            "with both": ("lidargrit_kitti_odometry", "lidargrit_small_both"),
        },
    ),
}


@dataclass(frozen=True)
class Reproduction:
    """A table of the paper to reproduce.

    Args:
        number: number of the table, 1 to 3.
        root: root folder of its data set, or ``simulated`` for simulated streets.
        small: whether to use the small presets, images of 64x256, and only the metrics that need no published weights.
        count: samples of each system, compared with as many scans; 0 for 5,000, or 64 if small.
        flops: operations of the training of each system; None for the presets' own budgets, or 5e13 if small.
        settings: settings of every preset, besides the table's own.
    """

    number: int
    root: str
    small: bool = False
    count: int = 0
    flops: float | None = None
    settings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.number not in TABLES:
            raise ConfigError(f"table {self.number}", f"one of {', '.join(map(str, TABLES))}", "choose one")

    @property
    def table(self) -> PaperTable:
        """The table."""
        return TABLES[self.number]

    def systems(self) -> dict[str, str]:
        """Return the preset of each row."""
        return {row: presets[self.small] for row, presets in self.table.rows.items()}

    def remarks(self) -> list[str]:
        """Return which preset measures which row, and what a reader of the rows must know."""
        rows = [f"the paper's row {row!r} is measured by {system}" for row, system in self.systems().items()]
        return [*rows, *self.table.remarks]

    def comparison(self) -> CompareConfig:
        """Return what all rows have in common."""
        protocol = load_protocol(self.table.protocol)
        count = self.count or (_SMALL_COUNT if self.small else protocol.num_scans)
        split = {"train": self.table.train}
        train, val = (f"data.{part}={json.dumps([self.source(split.get(part, part))])}" for part in ("train", "val"))
        images = self.table.small_images if self.small else self.table.images
        images = () if self.root == SIMULATED else images
        metrics = tuple(c.metric for c in protocol.metrics if not load_metric(c.metric).needs_weights)
        flops = self.flops if self.flops is not None else _SMALL_FLOPS if self.small else 0.0
        return CompareConfig(
            reference=f"simulated:{count}:test" if self.root == SIMULATED else self.source("test"),
            num_samples=count,
            settings=EvalConfig(protocol=self.table.protocol, metrics=metrics if self.small else ()),
            preset_settings=(train, val, *images, f"data.projection_variant={protocol.variant}", *self.settings),
            flops=flops,
        )

    def source(self, split: str) -> str:
        """Return where the scans of a split come from."""
        if self.root == SIMULATED:
            part = "train" if split == self.table.train else split
            return f"simulated:{_SIMULATED_SCANS[part]}:{part}"
        return f"{self.table.data_set}:{self.root}:{split}"


def prepare(comparison: CompareConfig, systems: Sequence[str]) -> None:
    """Project all training scans before anything is trained: one that cannot be used is refused now, not after days."""
    open_source(comparison.reference)  # refuses a split that is not there
    for data in [comparison.preset(system).data for system in systems]:
        load_range_images(data.train, data)
        load_range_images(data.val, data)


def plan(wanted: Reproduction, folder: Path) -> dict[str, Any]:
    """Return the steps of a reproduction and their costs, as plain values."""
    comparison = wanted.comparison()
    presets = {system: comparison.preset(system) for system in wanted.systems().values()}
    data = next(iter(presets.values())).data
    counted = {source: len(open_source(source).scans()) for source in (*data.train, *data.val, comparison.reference)}
    systems = {}
    for system, preset in presets.items():
        run = folder / "runs" / system
        sensor = preset.data.load_sensor()
        with torch.device("meta"):  # sizes alone, without values
            generator = preset.build_generator(sensor)
        systems[system] = {
            "state": "finished" if is_run(run) else "begun" if run.exists() else "to do",
            "plan": plan_training(preset).to_json(),
            "sampling_flops": generator.cost().flops * comparison.num_samples,
        }
    return {"table": wanted.number, "prepare": counted, "samples": comparison.num_samples, "systems": systems}


def plan_as_text(wanted: Reproduction, facts: dict[str, Any]) -> str:
    """Return a plan as lines for a person."""
    table = wanted.table
    lines = [f"table {wanted.number} of the paper: {table.title}, protocol {table.protocol}", ""]
    lines += [f"prepare {source}: {count:,} scans" for source, count in facts["prepare"].items()]
    for system, of in facts["systems"].items():
        lines += ["", f"train {system} ({of['state']}), {of['plan']['published'] or 'no published score'}"]
        for stage in of["plan"]["stages"]:
            lines.append(
                f"  {stage['name']}: {stage['scans']:,} scans, {computing_time(stage['flops'], stage['precision'])}"
            )
        lines.append(f"  sample {facts['samples']:,} scans: {of['sampling_flops']:.2g} floating-point operations")
    return "\n".join([*lines, "", *wanted.remarks()])
