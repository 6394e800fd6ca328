"""What a system of a comparison costs: parameters, operations, time and bits → costs.json → a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidargrit.core import reporting
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.files import read_json, write_json
from lidargrit.core.table import Table
from lidargrit.evaluation.likelihood import bits_per_return
from lidargrit.evaluation.pairs import EvalSet
from lidargrit.generation.generator import Generator
from lidargrit.generation.settings import Preset
from lidargrit.training import training_flops

COSTS = "costs.json"
HEADS = {  # entry of the file, None where it is not known → name and unit in tables
    "parameters": "parameters (all networks)",
    "training_flops": "training (FLOPs)",
    "flops_per_scan": "sampling (FLOPs/scan)",
    "network_evaluations": "network evaluations (per scan)",
    "seconds_per_scan": "time (s/scan)",
    "bits_per_return": "likelihood (bits/return)",
}
_NOTES = (
    "time: on this machine, in batches; likelihood: of at most 64 scans of the reference, ranges in steps of 10 mm, "
    "- where a system has none; MaskGIT's tokens count as equally likely",
)


@dataclass(frozen=True)
class Costs:
    """The file with what one system costs."""

    path: Path
    weights_sha256: str

    def write(
        self, generator: Generator, sampling: object, preset: Preset | None, timed: tuple[int, float] | None
    ) -> None:
        """Write what a system costs, unless that of these weights is there, with the time of at least as many scans.

        Args:
            preset: preset that was trained; None for a run that was given, whose training is not counted.
            timed: number of scans that were sampled just now, and seconds for each; None if none was.
        """
        scans, seconds = timed or (0, None)
        if self.path.is_file():
            there = read_costs(self.path)
            if there.get("weights_sha256") == self.weights_sha256 and scans <= there["scans"]:
                return
        cost = generator.cost(sampling)
        write_json(
            self.path,
            {
                "weights_sha256": self.weights_sha256,
                "parameters": sum(weight.numel() for weight in generator.parameters()),
                "training_flops": None if preset is None else sum(training_flops(preset).values()),
                "network_evaluations": cost.network_evaluations,
                "flops_per_scan": cost.flops,
                "seconds_per_scan": seconds,
                "scans": scans,  # over which the time was taken
                "bits_per_return": None,  # until they are added
            },
        )

    def write_unknown(self) -> None:
        """Write that nothing is known of the costs, as of samples that were there."""
        write_json(self.path, {"weights_sha256": self.weights_sha256, **dict.fromkeys(HEADS), "scans": 0})

    def add_bits(self, generator: Generator, scans: EvalSet) -> None:
        """Add the bits a return of the reference to the file, unless those of the same scans are there."""
        costs = read_costs(self.path)
        reference = {"sha256": scans.record().sha256, "range_m": list(scans.range_m or ())}
        if costs.get("reference") == reference:
            return
        try:
            bits = bits_per_return(generator, scans)
        except ConfigError as error:  # scans that the model cannot encode can still be compared with
            reporting.message(f"no likelihood of the reference: {error}")
            bits = None
        write_json(self.path, {**costs, "bits_per_return": bits, "reference": reference})


def read_costs(path: Path) -> dict[str, Any]:
    """Read what :class:`Costs` wrote."""
    of = read_json(path)
    for name in (*HEADS, "scans"):
        if name not in of or not (type(of[name]) in (int, float) or (of[name] is None and name != "scans")):
            cure = "remove the folder of this system, and compare again"
            raise CheckpointError(f"{path}, whose {name} is no number", "what lidargrit compare wrote", cure)
    return of


def costs_table(files: Sequence[tuple[str, Path]], remarks: Sequence[str] = ()) -> Table:
    """Return the costs of several systems."""
    rows = []
    for name, path in files:
        of = read_costs(path)
        numbers = [of[entry] for entry in HEADS]
        rows.append((name, *("" if number is None else _as_text(number) for number in numbers)))
    return Table(("system", *HEADS.values()), tuple(rows), "Costs", notes=(*_NOTES, *remarks))


def _as_text(number: int | float) -> str:
    return f"{number:,}" if isinstance(number, int) and number < 1e9 else f"{number:.4g}"
