"""Scores of generators compared alike, docs/results/scores.csv → tables and a picture; ``add`` takes more scores in.

    python benchmarks/fair_table.py table --metrics flying_points wall_straightness
    python benchmarks/fair_table.py table --trained-on "simulated:2000:train, then 38 KITTI scans" \\
        --data kitti_odometry --operations 1.55e14 --scans 20
    python benchmarks/fair_table.py ranks
    python benchmarks/fair_table.py plot budgets.png
    python benchmarks/fair_table.py add TABLE      # folder of lidargrit compare

A value in ``table`` is the mean over the seeds of training, and its interval reaches from the lowest bound of their
intervals over scans to the highest. Bold: the nearest trained system, if its interval overlaps with none of theirs.
"""

import argparse
import csv
import io
import statistics
import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from PIL import Image

from lidargrit.core.files import read_json, write_text

SCORES = Path(__file__).resolve().parents[1] / "docs" / "results" / "scores.csv"
STREETS, BOUNDS = "simulated:2000:train", ("`marginal`", "`memorised`")  # bounds are not trained
ORDER_BY = "sliced_wasserstein"
METRICS = (ORDER_BY, "bev_jsd", "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")
PLOTTED = (ORDER_BY, "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")
SYSTEMS = (
    *("LidarGRIT with a pixel decoder", "LidarGRIT", "pixel decoder without tokens", "MaskGIT", "DUSty-I", "DUSty-II"),
    *("DCGAN", "LidarGAN", "LidarGAN's VAE", "UltraLiDAR", "R2DM, 32 steps", "R2Flow, 16 steps", "R2Flow, 1 step"),
    *("LiDARGen", "LiDM", "LiDM, noise along two axes of its codes", "LiDM over LidarGRIT's tokens"),
    "LiDM over LidarGRIT's tokens, noise in all channels",
)
"""Systems that are shown; scores.csv also has rows of single changes to them."""
BUDGETS = {
    "1e13, OS1-64": ("1e+13", "1", "64", "simulated:256@os1_64:test"),
    "1e13": ("1e+13", "0", "64", "simulated:256:test"),
    "3e13": ("3e+13", "1", "64", "simulated:512:test"),
    "1.5e14": ("1.5e+14", "1", "512", "simulated:512:test"),
}
"""Operations, seed, number of scans and data of each column of the ranking."""


class Row(NamedTuple):
    """A score of one system, as a line of scores.csv has it."""

    system: str
    preset: str
    settings: str
    trained_on: str
    operations: str
    seed: str
    data: str
    data_sha256: str
    scans: str
    metric: str
    variant: str
    value: str
    low: str
    high: str
    real_against_real: str
    better: str
    parameters: str
    training_operations: str
    network_evaluations: str
    operations_a_scan: str
    seconds_a_scan: str
    bits_a_return: str
    commit: str

    @property
    def what(self) -> tuple[str, ...]:
        """What the row is a score of: everything but the score, its cost and its commit."""
        return self[: self._fields.index("value")]


class Score(NamedTuple):
    """A score over the seeds of a system."""

    value: float
    low: float
    high: float
    better: str
    seeds: int

    def nearer_than(self, other: "Score") -> bool:
        """Return whether this score is better, with intervals apart."""
        return self.low > other.high if self.better == "higher" else self.high < other.low


def read() -> list[Row]:
    """Return all rows of scores.csv."""
    with SCORES.open(encoding="utf-8", newline="") as file:
        _, *lines = csv.reader(file)
        return [Row._make(line) for line in lines]


def short(value: float) -> str:
    """Return a score with three decimals, or two digits if it is smaller than they can tell."""
    return f"{value:.1e}".replace("e-0", "e-") if 0 < abs(value) < 0.0005 else f"{value:.3f}".removeprefix("0")


def over_seeds(rows: Iterable[Row]) -> Score | None:
    """Return the score of rows of several seeds; None where there is none."""
    of = list(rows)
    if not of:
        return None
    low, high = min(float(row.low) for row in of), max(float(row.high) for row in of)
    return Score(statistics.mean(float(row.value) for row in of), low, high, of[0].better, len(of))


def of_default_variant(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of the default protocol, where a metric has several variants."""
    best: dict[tuple[str, ...], Row] = {}
    for row in rows:
        key = (row.system, row.seed, row.metric, row.operations)
        if key not in best or row.variant in ("exact", "textbook"):
            best[key] = row
    return list(best.values())


def nearest(scores: dict[str, Score | None]) -> str:
    """Return the trained system that is nearer than all others with intervals apart, or nothing."""
    found = {system: score for system, score in scores.items() if score and system not in BOUNDS}
    for system, score in found.items() if len(found) > 1 else ():
        if all(score.nearer_than(other) for name, other in found.items() if name != system):
            return system
    return ""


def table(options: argparse.Namespace) -> str:
    """Return systems by metrics."""
    budget = f"{float(options.operations):g}"
    held = [row for row in read() if (row.data, row.scans) == (options.data, options.scans)]
    shown = of_default_variant(
        row
        for row in held
        if row.system in BOUNDS
        or (row.system in SYSTEMS and row.trained_on == options.trained_on and row.operations == budget)
    )
    by: dict[str, dict[str, Score | None]] = {
        metric: {
            system: over_seeds(row for row in shown if (row.system, row.metric) == (system, metric))
            for system in dict.fromkeys(row.system for row in shown)
        }
        for metric in dict.fromkeys((*options.metrics, ORDER_BY))
    }
    if missing := [metric for metric in options.metrics if not any(by[metric].values())]:
        raise SystemExit(f"got no score by {missing[0]} of these scans; wanted what {SCORES.name} has; correct a name")
    trained = {system: score.value for system, score in by[ORDER_BY].items() if score and system not in BOUNDS}
    lines = [f"| | seeds | {' | '.join(f'`{metric}`' for metric in options.metrics)} |"]
    lines.append("|---|---|" + "---|" * len(options.metrics))
    bold = {metric: nearest(by[metric]) for metric in options.metrics}
    for system in [*sorted(trained, key=trained.__getitem__), *(one for one in BOUNDS if one in by[ORDER_BY])]:
        cells = []
        for metric in options.metrics:
            score, mark = by[metric][system], "**" if bold[metric] == system else ""
            at = f"{mark}{short(score.value)}{mark} [{short(score.low)}, {short(score.high)}]" if score else ""
            cells.append(at or "not applicable")
        seeds = max(score.seeds for of in by.values() if (score := of[system]))
        lines.append(f"| {system} | {seeds} | {' | '.join(cells)} |")
    real = {row.metric: float(row.real_against_real) for row in shown if row.real_against_real}
    lines.append(f"| real against real | | {' | '.join(short(real[metric]) for metric in options.metrics)} |")
    return "\n".join(lines)


def ranks(options: argparse.Namespace) -> str:
    """Return one metric over all budgets; = says that the interval overlaps with that of the rank before."""
    cells: dict[str, dict[str, str]] = defaultdict(dict)
    order: list[str] = list(SYSTEMS)
    for budget, wanted in BUDGETS.items():
        of = {row.system: row for row in read() if _is(row, options.metric, wanted) and row.system in SYSTEMS}
        before: Row | None = None
        sign = -1 if any(row.better == "higher" for row in of.values()) else 1
        ranked = sorted(of, key=lambda system: sign * float(of[system].value))
        for rank, system in enumerate(ranked, start=1):
            row = of[system]
            level = before and float(row.low) <= float(before.high) and float(row.high) >= float(before.low)
            cells[system][budget], before = f"{short(float(row.value))}{'=' if level else ''} ({rank})", row
        order.sort(key=lambda system: ranked.index(system) if system in ranked else len(ranked))
    lines = [f"| system | {' | '.join(BUDGETS)} |", "|---|" + "---|" * len(BUDGETS)]
    lines += [f"| {system} | {' | '.join(cells[system].get(one, '') for one in BUDGETS)} |" for system in order]
    return "\n".join(lines)


def _is(row: Row, metric: str, wanted: tuple[str, ...]) -> bool:
    return row.metric == metric and (row.operations, row.seed, row.scans, row.data) == wanted


def plot(options: argparse.Namespace) -> str:
    """Plot each system over the operations of training, and over the seconds of a scan at its largest budget."""
    held = [row for row in read() if row.scans == "64" and row.data in ("simulated:256:test", "simulated:512:test")]
    held = [row for row in held if row.trained_on == STREETS and row.system in SYSTEMS]
    figure = Figure(figsize=(13, 6.4), layout="constrained", dpi=72)
    axes = figure.subplots(2, len(PLOTTED))
    for column, metric in enumerate(PLOTTED):
        most = max(float(row.training_operations) for row in held)
        for number, system in enumerate(SYSTEMS):
            of = [row for row in held if (row.system, row.metric) == (system, metric)]
            of.sort(key=lambda row: float(row.training_operations))
            if not of:
                continue
            _errorbar(axes[0, column], of, "training_operations", number)
            hollow = float(of[-1].training_operations) < most / 2
            _errorbar(axes[1, column], of[-1:], "seconds_a_scan", number, hollow)
        floor = next(float(row.real_against_real) for row in held if row.metric == metric)
        for axis in axes[:, column]:
            axis.axhline(floor, color="grey", ls=":", lw=1, label="real against real")
            axis.set(xscale="log", yscale="log")
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
            axis.yaxis.set_minor_formatter("{x:g}")
            axis.grid(alpha=0.3)
        axes[0, column].set(title=metric, xlabel="operations of training")
        axes[1, column].set(xlabel="seconds a scan, one core")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    drawn = io.BytesIO()
    figure.savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(128).save(options.png, optimize=True)
    return f"done: {options.png}"


def _errorbar(axis: Axes, rows: list[Row], by: str, number: int, hollow: bool = False) -> None:
    """Plot the rows of the system of this number over a cost."""
    colour = colormaps["tab20"](number)
    values = [float(row.value) for row in rows]
    below = [value - float(row.low) for value, row in zip(values, rows, strict=True)]
    above = [float(row.high) - value for value, row in zip(values, rows, strict=True)]
    costs = [float(getattr(row, by)) for row in rows]
    look = axis.errorbar(costs, values, [below, above], label=SYSTEMS[number], color=colour, ms=5, lw=1)
    look.lines[0].set_marker("osD^v8<>PX*hdpH12x"[number])
    if hollow:
        look.lines[0].set_markerfacecolor("none")


def add(options: argparse.Namespace) -> str:
    """Take the scores of a folder of ``lidargrit compare`` into scores.csv."""
    rows = read()
    held = {row.what for row in rows}
    found = _of_folder(options.folder, rows)
    new = [row for row in found if row.what not in held]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([Row._fields, *rows, *new])
    write_text(SCORES, text.getvalue())
    return f"done: {len(new)} scores more in {SCORES}; {len(found) - len(new)} of {options.folder} were there already"


def _of_folder(folder: Path, known: list[Row]) -> list[Row]:
    """Return the scores of a folder as rows; a system has the name of a known row of its preset and settings."""
    data = read_json(folder / "table.json")
    chosen = dict(each.split("=", 1) for each in data["settings"]["preset_settings"])
    trained_on, seed = chosen.pop("data.train", "the preset's own"), chosen.pop("seed", "0")
    chosen.pop("data.val", "")
    changed = " ".join(f"{name}={value}" for name, value in chosen.items())
    names = {(row.preset, row.settings): row.system for row in known}
    asked = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    commit = asked.stdout.strip()  # nothing outside a checkout
    found = []
    for cell in data["cells"]:
        preset, _, sampling = cell["system"].partition(":")
        settings = " ".join(part for part in (sampling.replace(",", " "), changed) if part)
        card, costs = cell["scores"], cell["costs"]
        record = card["inputs"]["reference"]
        paid = [str(costs.get(name) or "") for name in ("parameters", "training_flops", "network_evaluations")]
        paid += [str(costs.get(name) or "") for name in ("flops_per_scan", "seconds_per_scan", "bits_per_return")]
        for score in card["scores"]:
            bounds = score["interval"] or {"low": "", "high": ""}
            real = (score["real_against_real"] or {"value": ""})["value"]
            cells = (
                *(names.get((preset, settings), cell["system"]), preset, settings, trained_on),
                *(f"{data['settings']['flops']:g}", seed, Path(record["source"]).name, record["sha256"][:8]),
                *(str(score["num_generated"]), score["metric"], score["variant"], str(score["value"])),
                *(str(bounds["low"]), str(bounds["high"]), str(real)),
                *("higher" if score["higher_is_better"] else "lower", *paid, commit),
            )
            found.append(Row._make(cells))
    return found


def main() -> None:
    """Read the options and print what they ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)

    def verb(does: Callable[[argparse.Namespace], str]) -> argparse.ArgumentParser:
        one = verbs.add_parser(does.__name__, help=(does.__doc__ or "").splitlines()[0])
        one.set_defaults(does=does)
        return one

    shown = verb(table)
    shown.add_argument("--metrics", nargs="+", default=list(METRICS))
    shown.add_argument("--operations", default="1.5e14", help="training budget (default: 1.5e14)")
    shown.add_argument("--trained-on", default=STREETS, help=f"scans of the training (default: {STREETS})")
    shown.add_argument("--data", default="simulated:512:test", help="scans to compare with")
    shown.add_argument("--scans", default="512", help="number of scans that were compared (default: 512)")
    verb(ranks).add_argument("--metric", default=ORDER_BY)
    verb(plot).add_argument("png", type=Path)
    verb(add).add_argument("folder", type=Path, help="folder of lidargrit compare")
    options = parser.parse_args()
    print(options.does(options))


if __name__ == "__main__":
    main()
