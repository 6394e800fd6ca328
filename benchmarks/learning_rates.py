"""Systems trained at several learning rates with equally many operations → scores on validation streets, side by side.

    OMP_NUM_THREADS=1 python benchmarks/learning_rates.py OUT r2dm_small:steps=32 lidargrit_fine_small --flops 3e12

Every system gets the same search: the rates of all its stages times each factor, one training each, the same budget and
seed, and as many samples against as many validation streets. Test streets are not touched, so that a rate may be chosen
here and its figures taken from there. OUT keeps runs, samples and scores, and the same command goes on there.
"""

import argparse
from pathlib import Path

from lidargrit.core import reporting
from lidargrit.core.configuration import override
from lidargrit.core.errors import TrainingError
from lidargrit.data.run_folder import is_run
from lidargrit.evaluation.compare import CompareConfig, as_table
from lidargrit.evaluation.compare import run as run_comparison
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.generation.presets import load_preset
from lidargrit.training import check_folder, train, training_flops, with_budget

METRICS = ("sliced_wasserstein", "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")


def main() -> None:
    """Train what is not there yet, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for runs, samples and scores")
    parser.add_argument("systems", nargs="+", metavar="SYSTEM", help="preset, with sampling settings after a colon")
    parser.add_argument("--factors", nargs="+", type=float, default=[1 / 3, 1, 3], help="of the preset's own rates")
    parser.add_argument("--flops", type=float, default=3e12, help="operations of each training")
    parser.add_argument("--against", default="simulated:64:val", metavar="SOURCE", help="validation scans")
    parser.add_argument("-n", "--count", type=int, default=64, help="number of samples of each")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of every preset")
    options = parser.parse_args()
    rows = []
    for system in options.systems:
        name, _, sampling = system.partition(":")
        scaled = with_budget(load_preset(name, options.set), options.flops)
        flops = sum(training_flops(scaled).values())
        for factor in options.factors:
            rates = {stage: fit.learning_rate * factor for stage, fit in scaled.training.items()}
            preset = override(scaled, [f"training.{stage}.learning_rate={rate!r}" for stage, rate in rates.items()])
            run = options.out / "runs" / f"{name}.rate{factor:g}"
            told = ", ".join(f"{stage} {rate:.2g}" for stage, rate in rates.items())
            reporting.message(f"{run.name}: {flops:.3g} floating-point operations, learning rates {told}")
            check_folder(run, preset)
            try:
                if not is_run(run):
                    train(preset, run)
            except TrainingError as error:  # it diverged
                reporting.message(f"{run.name} is left out: {error}")
                continue
            rows.append(f"{run}:{sampling}" if sampling else str(run))
    comparison = CompareConfig(options.against, options.count, EvalConfig(metrics=METRICS))
    print(as_table(run_comparison(rows, options.out, comparison)))


if __name__ == "__main__":
    with reporting.to(reporting.TerminalReporter()):
        main()
