"""Find the rows, columns and limits of a sensor in its scans, and write them as a sensor file."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_scans, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit fit-sensor /data/scans -o my_sensor.json --picture fit.png
  lidargrit train lidargrit_small runs/mine --set data.sensor=my_sensor.json data.columns=1024 data.column_stride=4 \\
    data.train=/data/scans data.val=/data/held_out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scans", help="folder, data set or file of scans that one sensor made")
    parser.add_argument("-o", "--out", type=Path, default=Path("my_sensor.json"), help="sensor file to write")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also plot the fitted rows beside the points")
    add_count(parser, 20)
    parser.add_argument("--name", help="name of the sensor (default: the name of the sensor file)")
    add_scans(parser, projects=False)
    add_json(parser, "the files of --out, --picture and --json")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core.files import refuse_to_overwrite, write_json
    from lidargrit.data.sources import open_source
    from lidargrit.scans.fit_sensor import fit_sensor_to_dataset
    from lidargrit.scans.fit_sensor.table import as_json, as_table

    refuse_to_overwrite(options.out, options.overwrite, ".json")
    refuse_to_overwrite(options.picture, options.overwrite, ".png")
    refuse_taken(options, replaces_others=True)
    name = options.out.stem if options.name is None else options.name
    config = scan_settings(options).data
    dataset = open_source(options.scans, config.bad_points).scans()
    fit = fit_sensor_to_dataset(dataset, name, options.count, config.bad_scans)
    if options.picture:
        from lidargrit.viewer.sensor_fit import plot_sensor_fit

        plot_sensor_fit(fit, options.picture)
    write_json(options.out, fit.sensor.to_json())
    done = f"done: {options.out}; use it with data.sensor={options.out} (train), or wherever a sensor is named"
    print_result(options, as_table(fit), {"sensor_file": str(options.out), **as_json(fit)}, done)
