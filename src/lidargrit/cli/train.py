"""Train a preset; the same command goes on where it stopped."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_scans, scan_words
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit train lidargrit_small runs/mine
  lidargrit train lidargrit_small runs/mine --set data.train=/data/scans data.val=/data/held_out
  lidargrit train lidargrit_kitti_360 runs/k360 --set data.train=/fast/k360 data.val=/fast/k360_val --dry-run
  torchrun --no-python --nproc-per-node=2 lidargrit train lidargrit_small runs/mine
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("preset", help="name of a preset; see: lidargrit list presets")
    parser.add_argument("out", type=Path, help="run folder to write; the same command continues there")
    settings = "settings of the preset to change, such as data.train=/data/scans; see all with --dry-run"
    add_scans(parser, settings)
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, with every setting, and stop")
    measuring = "like --dry-run, and take a few steps to estimate operations, time and memory"
    tracking = "also log to this project of Weights & Biases (pip install 'lidargrit[wandb]')"
    parser.add_argument("--wandb", default="", metavar="PROJECT", help=tracking)
    parser.add_argument("--measure", action="store_true", help=measuring)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit import training
    from lidargrit.core.errors import ConfigError
    from lidargrit.generation.generator import load_class
    from lidargrit.generation.presets import load_preset

    if options.json and not (options.dry_run or options.measure):
        raise ConfigError(
            "--json for a training", "--dry-run or --measure beside it", "read RUN/STAGE/log.jsonl instead"
        )
    refuse_taken(options)
    words, automatic = training.without_auto(scan_words(options))
    preset = training.with_best_batches(load_preset(options.preset, words), automatic, options.out)
    if options.dry_run or options.measure:
        training.check_folder(options.out, preset)
        planned = training.plan_training(preset)
        measured = training.measure(preset, planned.flops) if options.measure else []
        text = "\n".join([planned.as_text(), *(stage.as_text() for stage in measured)])
        print_result(options, text, {**planned.to_json(), "measured": [vars(stage) for stage in measured]})
        training.open_data(preset)  # last: the plan of a preset is worth reading on a machine without its data too
        return
    from lidargrit.viewer import plot_progress  # matplotlib, which a plan does not need

    training.train(preset, options.out, plot_progress, options.wandb)
    command = load_class(preset.generator).facts.first_command.replace("RUN", str(options.out))
    print(f"done: the model lies in {options.out}; try it with: lidargrit {command}")
