"""Scans of a sensor that nobody described → a sensor file, and what speaks for it → own_sensor.png."""

import sys
from dataclasses import replace
from pathlib import Path

import lidargrit
from lidargrit.core.files import write_json
from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.fit_sensor.table import as_table
from lidargrit.viewer.sensor_fit import plot_sensor_fit

COUNT = 10  # scans; five or more show all rings


def main(folder: Path, sensor_file: Path | None = None) -> None:
    """Fit a sensor to some scans that do not tell their rings, and show the fit."""
    unknown = lidargrit.load_sensor("vlp16")
    scans = [replace(lidargrit.simulate(seed, unknown), ring=None) for seed in range(COUNT)]
    fit = fit_sensor(scans, "mine")
    print(as_table(fit))
    plot_sensor_fit(fit, folder / "own_sensor.png")
    if sensor_file:  # every command that takes the name of a sensor takes this file
        write_json(sensor_file, fit.sensor.to_json())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
