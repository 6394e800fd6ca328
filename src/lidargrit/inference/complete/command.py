"""The verbs complete, upsample and raydrop: a source, a model and a folder → files."""

from pathlib import Path

from lidargrit.core.reporting import Reporter
from lidargrit.data.prepared.config import DataConfig
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.files import OutputConfig, write_completions
from lidargrit.inference.complete.inputs import InputScan, ScanReader, open_inputs
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.inference.complete.sparse import SparseReader, observed_rows
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


def complete_scans(
    source: str,
    out: Path,
    model: Model,
    pattern: Pattern,
    output: OutputConfig,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> int:
    """Write completions of the scans of a source, in which the observed pixels stand as they are.

    Args:
        source: a file, a folder or another source of scans, samples, prepared scans, or range images as ``.npy``.
        out: an empty folder, or one that the same command began.
        model: model or classical method; see :func:`lidargrit.inference.complete.open_model`.
        pattern: choice of the observed pixels.
        output: number and kind of files.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.

    Returns:
        Number of files.

    Raises:
        UsageError: all pixels are observed, or a mask of another size.
        ScanError: a scan that cannot be used, of another sensor, or without a return among the observed pixels.
    """
    config, reporter = config or DataConfig(), reporter or Reporter()

    def condition_of(scan: InputScan, seed: int) -> Observed:
        source = "a range image" if scan.points is None else scan.points.source
        return Observed.of_pixels(_batch(scan.image), pattern.mask(scan.image, seed, source)[None])

    inputs = open_inputs(source, _reader(model, pattern.partial), config, reporter)
    facts = {"verb": "complete", "source": source, **pattern.identity()}
    return write_completions(inputs, out, model, condition_of, output, facts, config, reporter)


def upsample_scans(
    source: str,
    out: Path,
    model: Model,
    scans_sensor: SensorModel,
    output: OutputConfig,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> int:
    """Write the scans of a sensor with few rows as those of the model's sensor, which has more.

    Args:
        scans_sensor: sensor that made the scans.
        source, out, model, output, config, reporter: the arguments of :func:`complete_scans`.

    Raises:
        ConfigError: sensors whose rows hardly look the same ways.
        ScanError: a scan that cannot be used, or of another sensor.
    """
    config, reporter = config or DataConfig(), reporter or Reporter()

    def condition_of(scan: InputScan, seed: int) -> Observed:
        return Observed.of_pixels(_batch(scan.image), observed_rows(scan)[None])

    reader = SparseReader(model.sensor, model.projection_variant, source=scans_sensor)
    inputs = open_inputs(source, reader, config, reporter)
    facts = {"verb": "upsample", "source": source, "scans_sensor": scans_sensor.to_json()}
    return write_completions(inputs, out, model, condition_of, output, facts, config, reporter)


def raydrop_scans(
    source: str,
    out: Path,
    model: Model,
    output: OutputConfig,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> int:
    """Write clean scans, such as a simulator's, without the returns that the model's sensor would not get.

    Args:
        source, out, model, output, config, reporter: the arguments of :func:`complete_scans`; the model takes
            ranges of surfaces.
    """
    config, reporter = config or DataConfig(), reporter or Reporter()

    def condition_of(scan: InputScan, seed: int) -> Observed:
        return Observed.of_surfaces(_batch(scan.image))

    inputs = open_inputs(source, _reader(model, partial=False), config, reporter)
    facts = {"verb": "raydrop", "source": source}
    return write_completions(inputs, out, model, condition_of, output, facts, config, reporter)


def _reader(model: Model, partial: bool) -> ScanReader:
    return ScanReader(model.sensor, model.projection_variant, partial)


def _batch(image: RangeImage) -> RangeImage:
    return RangeImage.stack([image])
