"""A source and the sensor that a user named → the sensor whose rays its scans lie on."""

import shlex

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import ScanSettings
from lidargrit.data.run_folder import Job, locate, takes_any_sensor
from lidargrit.data.sources import RunSource, open_source
from lidargrit.data.sources.source import Source
from lidargrit.scans.sensors import SensorModel, load_sensor


def sensor_for(source: Source, name: str) -> SensorModel:
    """Return the sensor of a name or a ``.json`` file, else that of a source."""
    return load_sensor(name) if name else source.sensor


def sensor_for_run(settings: ScanSettings, scans: str, model: str, job: Job = "sample") -> SensorModel | None:
    """Return the sensor of scans for a run that takes any: the named one, else that of their source, which is told.

    Args:
        scans: source of the scans.
        model: run; of one that knows its own sensor alone, None is returned, and another is refused.
    """
    if not takes_any_sensor(locate(model, job)):
        refuse_other_sensor(settings, model, job)
        return None
    return settings.data.with_projection(sensor_for(open_source(scans, settings.data.bad_points), settings.sensor))


def refuse_other_sensor(settings: ScanSettings, model: str, job: Job = "sample") -> None:
    """Refuse a sensor or columns that are not a run's own, which its networks know alone.

    Where no columns are set, those of the run are meant: scans of its sensor have all of them.
    """
    if not (settings.sensor or settings.data.columns):
        return
    own = RunSource(model, locate(model, job)).sensor
    sensor = settings.load_sensor() or settings.data.with_projection(own.fine())
    if not settings.data.columns and sensor.name == own.name and not sensor.has_angles_per_pixel:
        sensor = sensor.with_columns(own.width * own.column_stride, own.column_stride)
    if not own.same_rays(sensor):
        raise other_sensor(sensor, own, model, settings.sensor)


def other_sensor(sensor: SensorModel, own: SensorModel, model: str, typed: str = "") -> ConfigError:
    """Return the message about a sensor that was named for the scans of a run of another one.

    Args:
        typed: name or ``.json`` file by which the user named the sensor; "" if that is not known.
    """
    if sensor.name == own.name:
        cure = "name a run of these columns with --model, or leave the columns out"
    else:
        by = shlex.quote(typed) if typed else _to_type(sensor)
        seen = f"lidargrit rescan SCANS SEEN --sensor {by} --to {_to_type(own)}"
        cure = f"name a run of that sensor with --model, or first: {seen}, and take SEEN without --sensor"
    return ConfigError(
        f"the sensor {sensor.name!r}, {sensor.height}x{sensor.width}, for --model {model}",
        f"its own, {own.name!r}, {own.height}x{own.width}",
        cure,
    )


def _to_type(sensor: SensorModel) -> str:
    return sensor.name if sensor.name in discovery.names("sensors") else "SENSOR.json"
