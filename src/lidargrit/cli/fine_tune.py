"""Train the networks of the package further on scans of your own; the same command goes on where it stopped."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_scans, scan_words

EXAMPLES = """\
  lidargrit fine-tune /data/scans runs/mine --sensor os1_64
  lidargrit fine-tune kitti_odometry:/data/kitti:00 runs/kitti --dry-run     what would be done, and how long it takes
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("scans", help="scans to learn from: a folder, or NAME:ROOT:SPLIT")
    parser.add_argument("out", type=Path, help="run folder to write; the same command continues there")
    parser.add_argument("--val", metavar="SCANS", default="", help="scans to validate on (else some are held out)")
    add_scans(parser, "settings of the training to change, such as training.transformer.scans=2000")
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, and how long it takes")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core import reporting
    from lidargrit.training import check_folder, measure, plan_training, train, with_best_batches, without_auto
    from lidargrit.training.compute import duration
    from lidargrit.training.fine_tuning import fine_tuning_preset

    reporting.message("looking at the scans")
    words, automatic = without_auto(scan_words(options))
    preset = fine_tuning_preset(options.scans, options.sensor, words, options.val)
    preset = with_best_batches(preset, automatic, options.out)
    check_folder(options.out, preset)
    plan = plan_training(preset)
    said = ", ".join(f"{stage} {preset.settings_of(stage).scans:,}" for stage in plan.flops)
    reporting.message(f"scans seen: {said}; stop it at any time, the same command goes on")
    reporting.message("timing some steps of each stage")
    seconds = sum(stage.seconds for stage in measure(preset, plan.flops))
    reporting.message(f"training takes about {duration(seconds)} at the speed of these steps, beside validation")
    if options.dry_run:
        print(plan.as_text())
        return
    train(preset, options.out)
    val = preset.data.val[0]
    print(f"done: lidargrit sample {options.out} samples -n 16, or --model {options.out} wherever a run is wanted")
    print(f"bits and errors on scans that it did not learn from: lidargrit likelihood {val} --model {options.out}")
