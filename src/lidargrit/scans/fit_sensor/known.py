"""A fitted sensor → sentences: the package has this very sensor, or its files may be mirrored."""

from collections.abc import Iterator

import numpy as np

from lidargrit.core import discovery
from lidargrit.scans.fit_sensor.elevations import FittedRows
from lidargrit.scans.fit_sensor.rings import Rings
from lidargrit.scans.projection.pixel_coordinates import row_elevation_rad
from lidargrit.scans.sensors import load_sensor

_SAME_AT_MOST = 0.25  # of the usual step between rows, in the mean: half of it would be the neighbours'


def notes_on_sensor(rows: FittedRows, rings: Rings) -> Iterator[str]:
    """Yield what is known of a sensor from elsewhere: its name, and in which direction such sensors turn.

    The lidars of Velodyne, Hesai and Ouster turn clockwise, seen from above. Files that keep one firing after another
    show it; those that are sorted ring by ring may be sorted either way.
    """
    fitted_deg = rows.elevation_deg
    step_deg = float(np.median(np.abs(np.diff(fitted_deg))))
    off_deg = {
        name: float(np.abs(fitted_deg - np.degrees(row_elevation_rad(sensor))).mean())
        for name in discovery.names("sensors")
        if (sensor := load_sensor(name)).height == len(fitted_deg)
    }
    nearest = min(off_deg, key=lambda name: off_deg[name], default="")
    if nearest and off_deg[nearest] < _SAME_AT_MOST * step_deg:
        how = f"its rows lie {off_deg[nearest]:.2f} degrees from these in the mean"
        yield f"the package has this sensor: {nearest} ({how}); --sensor {nearest} needs no file"
    if rings.lasers and rings.counter_clockwise:
        yield (
            "it turns counter-clockwise, seen from above, where lidars turn clockwise: the files may be mirrored (y to "
            "the right, as CARLA has it), or the sensor hangs upside down"
        )
