"""What data sets of simulated streets share: a count and a split → seeds, one street each."""

from pathlib import Path
from typing import ClassVar

from lidargrit.core.errors import DataError, nearest_names
from lidargrit.data.datasets import ScanDataset, SplitScheme
from lidargrit.data.datasets.shared.splits import Split
from lidargrit.data.formats import BadPoints
from lidargrit.scans.sensors import load_sensor

STREETS_VERSION = 4
"""Version of what a seed makes; recordings tell it. 2 has set-ups of sensors; 3 has streets that bend and end;
4 differs from 3 in glass, which returns to some sensors; for KITTI's both are equal."""
_SEEDS_APART = 1_000_000  # distance between the splits' first seeds, and so the largest count


class Streets(ScanDataset):
    """Simulated streets; a split is a range of seeds, so that no scene is in two. ``all`` is ``train``.

    Args:
        root: the number of scans, where other data sets have a folder; behind an @, the name or ``.json`` file of the
            sensor that scans the streets.
        split: ``train``, ``val`` or ``test``.
        bad_points: without effect; the simulator makes none.

    Attributes:
        seeds: seeds of the streets.
        made_by: sensor that scans them.
    """

    licence = "none needed: made by this program"
    citation = "none needed: made by this program"
    tree = "COUNT, a number of scans from 1 to 1000000, not a folder, or COUNT@SENSOR"
    sensor = "hdl64e_kitti_odometry"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "seeds": SplitScheme(
            source="lidargrit",
            leak="None: every street is sampled anew.",
            parts={"train": ("0",), "val": ("1000000",), "test": ("2000000",)},  # the first seed of each
        )
    }

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        super().__init__(root, split, bad_points)
        digits, at, sensor = str(root).partition("@")
        count = int(digits) if digits.isdecimal() and len(digits) <= 7 and bool(at) == bool(sensor) else 0
        if not 1 <= count <= _SEEDS_APART:
            raise DataError(
                f"{str(root)!r} where a count belongs", self.tree, f"type for example {self.public_name()}:1000"
            )
        self.sensor = sensor or self.sensor
        self.made_by = load_sensor(self.sensor)  # read once: a file may change while streets are made
        wanted = Split.parse(split)
        first_seeds = {**self.splits(), "all": self.splits()["train"]}
        name = "+".join(wanted.parts)
        if name not in first_seeds:
            raise DataError(
                f"the split {split!r} of simulated scans",
                f"one such as {nearest_names(name, first_seeds)}",
                f"type for example {self.public_name()}:1000:val",
            )
        first_seed = int(first_seeds[name][0])
        self.seeds = range(first_seed, first_seed + count)[wanted.block(count)]
        if not self.seeds:
            raise DataError(
                f"the split {split!r} of {count} scans, which leaves none", "at least one scan", "ask for more"
            )

    def __len__(self) -> int:
        return len(self.seeds)

    def name(self, index: int) -> str:
        """Name one scan by its seed: "seed_0000012"."""
        return f"seed_{self.seeds[index]:07d}"

    def recording(self, index: int) -> str:
        """Name the street of a scan by the version of the streets and its seed, which no other scan shares."""
        return f"simulated/streets {STREETS_VERSION}/{Streets.name(self, index)}"

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Return False: simulated scans are only opened by name."""
        return False
