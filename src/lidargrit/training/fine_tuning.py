"""A user's scans → the preset that trains the networks of the package further on them."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from lidargrit.core import reporting
from lidargrit.core.configuration import override
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import PRETRAINED, locate, read_config
from lidargrit.data.sources import open_source
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset
from lidargrit.scans.sensors import SensorModel, load_sensor

_PRESET = "lidargrit_demo_fine_tuned"
_TIMES_OF_DEMO = 10  # as many scans seen as the demo's preset says, where there are enough to see
_ENOUGH_SCANS = 400  # for all of these; fewer scans are seen in proportion, but no fewer than the demo's preset says


def divided(data: str, max_scans: int = 0, if_few: str = "add scans", sensor: str = "") -> DataConfig:
    """Divide a user's scans into train and val, by whole drives where there are several.

    The same drive in both would leak. Held out is the drive that is nearest to 15 % of the scans; where there is only
    one, its last scans are held out, and a warning says so.

    Args:
        data: name of a data set, or of a folder of scans.
        if_few: cure of too few scans.
        sensor: name or file of the sensor that made the scans; that of the data set if empty.
    """
    opened = open_source(data)
    dataset = opened.scans()
    if len(dataset) < 4:
        raise DataError(f"{counted_scans(len(dataset))} in {data}", "at least 4, to hold one out", if_few)
    source, split = f"{dataset.public_name()}:{dataset.root}", dataset.split
    scans = Counter(dataset.name(index).rpartition("/")[0] for index in range(len(dataset)))
    drives = sorted(scans)
    has_drives = dataset.public_name() != "folder" and all(drive and "/" not in drive for drive in drives)
    if has_drives and len(drives) > 1 and "[" not in split:
        held_out = min(reversed(drives), key=lambda drive: abs(scans[drive] / len(dataset) - 0.15))
        train = f"{source}:{'+'.join(drive for drive in drives if drive != held_out)}"
        val = f"{source}:{held_out}"
    elif "[" in split:
        raise DataError(
            f"{data} with a share", "whole drives, or a folder", "leave the brackets out: the scans are divided here"
        )
    else:
        reporting.message(
            "WARNING: the last scans are held out; if they are of the same drive, they show the same streets"
        )
        train, val = f"{source}:{split}[:85%]", f"{source}:{split}[85%:]"
    return DataConfig(train=(train,), val=(val,), sensor=sensor or opened.sensor_name, max_scans=max_scans)


def _all_to_train(data: str, val: str, sensor: str) -> DataConfig:
    train, held_out = (open_source(source) for source in (data, val))
    train.scans()
    held_out.scans()  # refused now, not after the first stage
    return DataConfig(train=(data,), val=(val,), sensor=sensor or train.sensor_name)


def fine_tuning_preset(data: str, sensor: str = "", settings: Sequence[str] = (), val: str = "") -> Preset:
    """Return the preset that trains all networks of ``pretrained`` further on a user's scans.

    Stages and learning rates are those of ``lidargrit_demo_fine_tuned``. Scans seen grow with the number of scans that
    there are, up to ten times that preset's from 400 scans on. Images have the rows of the scans' sensor, and as many
    columns as those of ``pretrained``.

    Args:
        data: name of a data set, or of a folder of scans.
        sensor: name or ``.json`` file of the sensor that made the scans; that of the data set if empty.
        settings: changed settings of the preset, as ``--set`` takes them.
        val: scans to validate on; some of the scans are held out if empty.
    """
    few = "add scans, or name others with --val"
    config = _all_to_train(data, val, sensor) if val else divided(data, if_few=few, sensor=sensor)
    own, made_by = read_config(locate(PRETRAINED)).sensor, load_sensor(config.sensor)
    columns, stride = columns_like(own, made_by)
    if made_by.height != own.height:
        of = f"data.sensor={config.sensor} data.columns={columns} data.column_stride={stride}"
        raise ConfigError(
            f"scans of {made_by.height} rows, of the sensor {made_by.name!r}",
            f"{own.height} rows: the networks of the package have weights for every row",
            f"train new ones: lidargrit train lidargrit_small OUT --set {of} "
            + shlex.join([f"data.train={config.train[0]}", f"data.val={config.val[0]}"]),
        )
    config = replace(config, columns=columns, column_stride=stride)
    preset = replace(load_preset(_PRESET), title="networks of the package, trained further", data=config)
    count = sum(len(open_source(source).scans()) for source in config.train)
    times = min(_TIMES_OF_DEMO, max(1, round(_TIMES_OF_DEMO * count / _ENOUGH_SCANS)))
    longer = {
        stage: replace(of, scans=of.scans * times, average_over_scans=of.average_over_scans * times)
        for stage, of in preset.training.items()
    }
    return override(replace(preset, training=longer), list(settings))


def columns_like(wanted: SensorModel, sensor: SensorModel) -> tuple[int, int]:
    """Return the number of fine columns, and the step between kept ones, of images of a sensor as wide as wanted."""
    fine = sensor.width * sensor.column_stride
    stride = max(1, round(fine / wanted.width))
    return wanted.width * stride, stride
