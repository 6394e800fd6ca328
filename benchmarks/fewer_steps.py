"""Quality against seconds a scan: a LidarGRIT run, token by token, beside runs that take few steps, in several numbers.

    python benchmarks/fewer_steps.py OUT EXACT_RUN RUN [RUN ...] [-n 256] [--steps 8 16 32 64]
    python benchmarks/fewer_steps.py OUT runs/small runs/maskgit runs/r2dm runs/r2flow runs/r2flow_1:1 --steps 4 16

Runs of MaskGIT, R2DM, R2Flow and the like take the steps of --steps, or those behind their own colon, as a model of
R2Flow that was distilled to one step does. Every system makes the same number of samples, which are scored against
simulated scans that none was trained on, by three metrics with their 95 % intervals; OUT keeps samples and scores, and
the same command goes on there. Seconds are of whole scans, seed to range image, the best of the repeats; with
OMP_NUM_THREADS=1 they are the processor's, which do not count waiting for neighbours. Prints the table and plots them.
"""

import argparse
import time
from functools import partial
from pathlib import Path

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from lidargrit.core import reporting
from lidargrit.core.configuration import override
from lidargrit.evaluation.benchmark import Benchmark
from lidargrit.evaluation.benchmark import run as run_benchmark
from lidargrit.evaluation.comparison import EvalConfig
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator, load

COLOURS = ("#d1495b", "#3a7d44", "#8a5fbf", "#c07f1a")
METRICS = {"sliced_wasserstein": "textbook", "point_cloud_jsd": "exact", "return_rate_per_ring": "exact"}  # → variant


def seconds_per_scan(generator: Generator, sampling: object, batch: int) -> float:
    """Return the time, the least of three for a scan at a time; the first call, which prepares, is not counted."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    work, times = partial(generator.sample, range(batch), sampling=sampling), []
    work()
    for _ in range(3 if batch == 1 else 1):
        begun = clock()
        work()
        times.append((clock() - begun) / batch)
    return min(times)


def plot(rows: list[dict], path: Path, title: str, batch: int) -> None:
    """Plot a panel for each metric: its value with the interval over the seconds of a scan in batches of one size."""
    figure = Figure(figsize=(13.0, 4.2), dpi=100)
    FigureCanvasAgg(figure)
    names = list(dict.fromkeys(row["name"] for row in rows[1:]))
    for index, metric in enumerate(METRICS):
        axes = figure.add_subplot(1, len(METRICS), index + 1)
        first = {row["name"]: row for row in reversed(rows)}
        for row in rows:
            value, low, high, _ = row[metric]
            exact = row["steps"] is None
            label = "one by one" if exact else f"{row['steps']}"
            axes.errorbar(
                row["seconds"][0],
                value,
                [[max(0.0, value - low)], [max(0.0, high - value)]],
                fmt="s" if exact else "o",
                color="#26323c" if exact else COLOURS[names.index(row["name"]) % len(COLOURS)],
                capsize=3,
                label=row["name"] if exact or row is first[row["name"]] else None,
            )
            axes.annotate(
                label,
                (row["seconds"][0], value),
                xytext=(-4, 8) if exact else (5, 6),
                ha="right" if exact else "left",
                textcoords="offset points",
                fontsize=9,
            )
        axes.axhline(rows[0][metric][3], color="#2a8fbd", linestyle=":", label="real against real")
        axes.set_xscale("log")
        axes.margins(x=0.15)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(bottom=0)
        axes.set(
            title=metric, xlabel=f"seconds a scan, {batch} at once, one thread", ylabel="distance, lower is better"
        )
    figure.suptitle(title)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=9, loc="lower center", ncols=len(names) + 2)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def row_of(name: str, steps: int | None, scores: Path, seconds: list[float]) -> dict:
    """Return what a line of the table and a point of the plot need."""
    row: dict = {"name": name, "steps": steps, "seconds": seconds}
    for score in Scorecard.read(scores).scores:
        if score.result.variant != METRICS[score.result.metric]:
            continue
        assert score.interval is not None
        reference = score.real_against_real
        assert reference is not None
        row[score.result.metric] = [score.result.value, score.interval.low, score.interval.high, reference.value]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("exact_run", type=Path)
    parser.add_argument("few_step_runs", nargs="+", metavar="RUN[:STEPS,...]")
    parser.add_argument("-n", type=int, default=256)
    parser.add_argument("--steps", type=int, nargs="+", default=[8, 16, 32, 64])
    parser.add_argument("--choices", nargs="*", default=[], metavar="NAME=VALUE", help="further choices of these runs")
    parser.add_argument(
        "--batch", type=int, nargs="+", default=[8, 1], help="scans at once, in the timing; the first is plotted"
    )
    parser.add_argument("--picture", type=Path, default=Path("quality_against_seconds.png"))
    parser.add_argument("--title", default="")
    options = parser.parse_args()
    few: list[tuple[str, int]] = []
    for words in options.few_step_runs:
        run, _, own = words.partition(":")
        few += [(run, steps) for steps in (map(int, own.split(",")) if own else options.steps)]
    chosen = [[f"steps={steps}", *options.choices] for _, steps in few]
    systems = [
        str(options.exact_run),
        *(f"{run}:{','.join(words)}" for (run, _), words in zip(few, chosen, strict=True)),
    ]
    benchmark = Benchmark(f"simulated:{options.n}:test", options.n, EvalConfig(metrics=tuple(METRICS)))
    scores = run_benchmark(systems, options.out, benchmark)
    rows = []
    for (run, steps), words, path in zip([(options.exact_run, None), *few], [[], *chosen], scores, strict=True):
        generator = load(run)
        sampling = override(generator.Sampling(), words)
        seconds = [seconds_per_scan(generator, sampling, batch) for batch in options.batch]
        rows.append(row_of(Path(run).name, steps, path, seconds))
    heads = [*(f"seconds, batch {batch}" for batch in options.batch), *METRICS]
    print(f"| {options.n} scans | passes | {' | '.join(heads)} |\n|---|---|{'---|' * len(heads)}")
    for row in rows:
        cells = [*(f"{each:.3f}" for each in row["seconds"])]
        cells += [f"{row[metric][0]:.4f} ({row[metric][1]:.4f} to {row[metric][2]:.4f})" for metric in METRICS]
        print(f"| {row['name']} | {row['steps'] or 'one a token'} | {' | '.join(cells)} |")
    print("real against real: " + ", ".join(f"{metric} {rows[0][metric][3]:.4f}" for metric in METRICS))
    plot(rows, options.picture, options.title, options.batch[0])


if __name__ == "__main__":
    with reporting.to(reporting.TerminalReporter()):
        main()
