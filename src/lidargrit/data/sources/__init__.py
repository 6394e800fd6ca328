"""Sources of scans, by what a user types → one object with the kind, the data and the provenance of the source."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from lidargrit.core import reporting
from lidargrit.core.errors import DataError, LidarGritError, ScanError, no_usable_scan
from lidargrit.data.datasets import ScanDataset, data_set_and_split, open_dataset
from lidargrit.data.formats import BadPoints
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.prepared.imaging import ProjectionChoice, choose_projection
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.prepared.prepared import PreparedFolder, PreparedImages, is_prepared
from lidargrit.data.run_folder import is_run, is_unfinished, locate, read_config, recorded_projection
from lidargrit.data.sources.image_files import ImageFileSource, image_files
from lidargrit.data.sources.memory import CutSource
from lidargrit.data.sources.sample_formats import (
    load_sample_format,
    read_tensor_folder,
    recognise,
    samples_in,
    sensor_of_tensors,
)
from lidargrit.data.sources.samples import is_sample_folder, read_facts, read_samples
from lidargrit.data.sources.source import Source
from lidargrit.scans.many_scans import usable_scans
from lidargrit.scans.projection.sensor_check import closest_sensor
from lidargrit.scans.sensors import SensorModel, load_sensor


class DatasetSource(Source):
    """Scans of a data set: files in a known layout, or simulated scans."""

    kind, has_points = "scans", True

    def __init__(self, text: str, bad_points: BadPoints = "refuse") -> None:
        super().__init__(text)
        self._dataset = open_dataset(text, bad_points)
        is_of_others = self._dataset.origin_of(self._dataset.root) == "folder"
        self.data_set = "folder" if is_of_others else self._dataset.public_name()
        self.split = self._dataset.split

    @property
    def sensor(self) -> SensorModel:
        """Sensor that made the scans; see :attr:`sensor_name`."""
        return load_sensor(self.sensor_name)

    @property
    def sensor_name(self) -> str:
        """Name or file of the sensor that made the scans; of files that name none, the one that looks closest."""
        return self._sensor_name

    @cached_property
    def _sensor_name(self) -> str:
        if self._dataset.named_sensor:
            return self._dataset.named_sensor
        try:
            (scan,), _ = usable_scans(self._dataset, range(len(self._dataset)), at_most=1)
        except ScanError:  # of all of them, and told where they are used
            return self._dataset.sensor
        name = closest_sensor(scan)
        told = f"{self.text}: no sensor is named, so {name} is taken, which looks closest; --sensor names another"
        reporting.message(told)
        return name

    def scans(self) -> ScanDataset:
        """Return the data set, as it was opened."""
        return self._dataset

    def cut(self, num_points: int) -> Source:
        """Return the source with the first points of each scan alone, which no cache keeps."""
        return CutSource(self, num_points)

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Project the scans once, and find them in the cache from then on."""
        imaging = self.imaging(sensor, config)
        imaging.report()
        sensor, config = imaging.sensor, imaging.config
        folder = prepare(self.text, config, sensor=sensor, dataset=self._dataset)
        prepared = PreparedImages(str(folder))
        self.doubts, self.projection_variant = (*imaging.doubts, *prepared.doubts()), config.projection_variant
        _require_some(self.text, prepared)
        return RangeImages(sensor, [prepared])

    def imaging(self, sensor: SensorModel | None, config: DataConfig) -> ProjectionChoice:
        """Choose how the scans become images: see :func:`lidargrit.data.prepared.imaging.choose_projection`.

        Args:
            sensor: sensor of the images; the data set's own, with the configuration's columns, if not given.
        """
        return choose_projection(self.text, self._dataset, sensor or config.with_projection(self.sensor), config)


class PreparedSource(Source):
    """Range images that ``lidargrit prepare`` wrote into a folder, here or behind a URL."""

    kind = "prepared range images"

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._prepared = PreparedImages(text)
        self.data_set, self.split = _data_set_or_nothing(self._prepared.spec.source)
        self.projection_variant = self._prepared.spec.variant

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the images, with all its fine columns."""
        return self._prepared.sensor

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Read the images, with all columns that were prepared, or with fewer if the sensor has fewer."""
        sensor = sensor or self.sensor
        chosen = self._prepared.evenly_spaced(config.max_scans) if config.max_scans else self._prepared
        store = chosen.on_rays_of(sensor, config.projection_variant)
        if store is not chosen:
            columns = f"{self.sensor.width} columns gathered into {sensor.width * sensor.column_stride}"
            reporting.message(f"{self.text}: {columns}, of each pixel the nearest return")
        _require_some(self.text, chosen)
        self.doubts = chosen.doubts()
        return RangeImages(sensor, [store])


class SampleSource(Source):
    """A folder of samples that ``lidargrit sample`` wrote."""

    kind, data_set = "generated range images", "samples"

    def __init__(self, text: str, folder: Path) -> None:
        super().__init__(text)
        self._folder = self.folder = folder
        self._sensor, self.projection_variant, self.full_rows, self.weights_sha256, _ = read_facts(folder)

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the samples."""
        return self._sensor

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Read the samples, or so many of them, evenly spaced."""
        return read_samples(self._folder, config.max_scans or None)


class TensorSource(Source):
    """A folder of samples as another program writes them, in files of tensors.

    Args:
        samples_format: name of the sample format; recognised from the first file if empty.
    """

    kind, data_set = "generated range images", "samples"

    def __init__(self, text: str, folder: Path, samples_format: str = "") -> None:
        super().__init__(text)
        self._folder, self.split = folder, samples_format or recognise(folder)
        self.projection_variant = load_sample_format(self.split).variant

    @property
    def sensor(self) -> SensorModel:
        """Sensor that the size of the first tensor fits."""
        return sensor_of_tensors(self._folder, self.split)

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Read the samples, or so many of them, evenly spaced."""
        return read_tensor_folder(self._folder, self.split, config.max_scans or None)


class RunSource(Source):
    """A finished run: it holds no scans, but scans can be generated with it."""

    kind = "a trained model"

    def __init__(self, text: str, folder: Path) -> None:
        super().__init__(text)
        self.folder, self.projection_variant = folder, recorded_projection(folder)
        self._sensor = read_config(folder).sensor

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the scans that are generated."""
        return self._sensor

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Refuse: scans have to be generated first."""
        cure = f"generate some first with: lidargrit sample {self.text} FOLDER"
        raise DataError(f"{self.text}, which holds {self.kind}", "scans or samples", cure)


def open_source(text: str, bad_points: BadPoints = "refuse", samples_format: str = "") -> Source:
    """Recognise the kind of a source, and open it.

    Args:
        text: folder of a finished run, ``pretrained`` or ``pretrained_wide``; folder of samples, of ours or of another
            program (``.pth``); folder or URL of prepared scans; range images as ``.npy``, one file or a folder of
            nothing else; or a data set as in :func:`lidargrit.data.datasets.open_dataset` ("kitti_raw:ROOT:SPLIT",
            "FOLDER", "simulated:COUNT", ...).
        bad_points: treatment of NaN, infinite and origin points in scans.
        samples_format: program that wrote a folder of ``.pth`` files; recognised from the first file if empty.

    Raises:
        DataError: nothing that is known lies there.
        UnknownNameError: no data set or sample format of that name.

    Example:
        >>> open_source("simulated:8:test").data_set
        'simulated'
    """
    try:
        folder = Path(locate(text)).expanduser()
        here = folder.is_dir()
    except RuntimeError:  # what pathlib raises
        raise DataError(f"{text[:40]!r}, in a home folder that is not there", "another user's", "check it") from None
    except PermissionError:
        raise DataError(
            f"{text}, which may not be read", "a source that you may read", "change its permissions"
        ) from None
    except (OSError, ValueError) as error:  # a name too long, or with NUL
        if ":" not in text:
            raise DataError(f"{text[:40]!r}, which names no folder ({error})", "a source", "check the path") from None
        folder, here = Path(), False
    if samples_format:
        return TensorSource(text, samples_in(folder, samples_format) or folder, samples_format)
    if here and is_run(folder):
        return RunSource(text, folder)
    if here and is_sample_folder(folder):
        return SampleSource(text, folder)
    if here and is_unfinished(folder):
        read_config(folder)  # which says so
    if (of_others := samples_in(folder)) is not None:
        return TensorSource(text, of_others)
    if "://" in text or (here and is_prepared(text)):
        return PreparedSource(text)
    images = image_files(folder) if text and (here or folder.is_file()) else []
    return ImageFileSource(text, folder, images) if images else DatasetSource(text, bad_points)


def load_range_images(sources: Sequence[str], config: DataConfig) -> RangeImages:
    """Open the range images of several sources as one set, to train from or to watch.

    Scans are projected once and then found in the cache: ``$LIDARGRIT_CACHE``, else ``lidargrit`` in the user's cache
    folder. It may be deleted at any time.

    Args:
        sources: names of data sets, folders of scans, and prepared folders, as in :class:`DataConfig`.
        config: settings of projecting scans; its own sources are ignored.

    Raises:
        DataError: no source, a source without a scan, generated scans, or prepared scans of another sensor.
        ScanError: a scan that cannot be used; ``bad_scans=skip`` leaves it out.
    """
    return joined_images(open_to_train(sources, config), config)


def joined_images(opened: Sequence[DatasetSource | PreparedSource], config: DataConfig) -> RangeImages:
    """Return the range images of sources that :func:`open_to_train` has opened as one set."""
    if config.own_sensors:
        return RangeImages.joined(None, [source.images(source.sensor, config) for source in opened])
    sensor = config.load_sensor()
    return RangeImages.joined(sensor, [source.images(sensor, config) for source in opened])


def open_to_train(sources: Sequence[str], config: DataConfig) -> list[DatasetSource | PreparedSource]:
    """Open sources of real or simulated scans, or raise DataError where :func:`load_range_images` would."""
    if not sources:
        raise DataError("no source of scans", "at least one", "name one with --set data.train=FOLDER")
    opened = []
    for text in sources:
        source = open_source(text, config.bad_points)
        if not isinstance(source, (DatasetSource, PreparedSource)):
            cure = "export samples first if you do want to learn from them: lidargrit export SAMPLES FOLDER"
            raise DataError(f"{text}, which holds {source.kind}", "scans, or scans that were prepared", cure)
        opened.append(source)
    return opened


def open_images(text: str, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
    """Open the range images of one source; see :func:`open_source` and :meth:`Source.images`."""
    return open_source(text, config.bad_points).images(sensor, config)


def overlap(source: Source, images: RangeImages | None, reference: Provenance) -> str:
    """Return in a few words which scans a source, or the model behind it, shares with the reference; "" for none.

    Args:
        source: source of the set; of samples and runs, the training scans of the model count, too.
        reference: provenance of the set that it is compared with.
    """
    own = Provenance() if images is None else images.provenance
    learned_from = source.learned_from() or Provenance()
    return own.overlap(reference) or learned_from.overlap(reference)


def data_set_of(text: str) -> tuple[str, str]:
    """Return the data set and the split of a source without opening its scans; "" for what is not known.

    Prepared scans are of the data set that they were prepared from. A URL is not asked: that may take long.
    """
    if "://" in text:
        return "", ""
    try:
        return _data_set_or_nothing(PreparedFolder(text).read_spec().source if is_prepared(text) else text)
    except LidarGritError:
        return "", ""


def _data_set_or_nothing(text: str) -> tuple[str, str]:
    try:
        return data_set_and_split(text)
    except LidarGritError:
        return "", ""


def _require_some(text: str, prepared: PreparedImages) -> None:
    """Tell which scans were left out and what some lack, and raise DataError if none is left."""
    for remark in prepared.remarks():
        reporting.message(remark)
    if not len(prepared):
        raise no_usable_scan(text)
