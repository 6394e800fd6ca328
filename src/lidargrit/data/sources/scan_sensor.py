"""A source and the sensor that a user named → the sensor whose rays its scans lie on."""

from lidargrit.core.errors import ConfigError
from lidargrit.data.run_folder import Job, locate
from lidargrit.data.sources import RunSource
from lidargrit.data.sources.source import Source
from lidargrit.scans.sensors import SensorModel, load_sensor


def sensor_for(source: Source, name: str) -> SensorModel:
    """Return the sensor of a name or a ``.json`` file, else that of a source."""
    return load_sensor(name) if name else source.sensor


def refuse_other_sensor(name: str, model: str, job: Job = "sample") -> None:
    """Refuse the name of a sensor that is not a run's own, which its networks know alone; "" names none."""
    if not name:
        return
    own, sensor = RunSource(model, locate(model, job)).sensor, load_sensor(name)
    if not own.same_rays(sensor):
        raise ConfigError(
            f"the sensor {sensor.name!r}, {sensor.height}x{sensor.width}, for --model {model}",
            f"its own, {own.name!r}, {own.height}x{own.width}",
            "leave the sensor out, or name another model",
        )
