"""The whole pipeline: scans → range images → trained networks → new scans → scores → one page."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from lidargrit.core import reporting
from lidargrit.core.configuration import override
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import CheckpointError
from lidargrit.core.files import read_json, write_json
from lidargrit.data.images import RangeImages
from lidargrit.data.run_folder import PRETRAINED, RUN_FILE, locate, read_config
from lidargrit.data.sources import load_range_images, open_source
from lidargrit.data.sources.samples import read_samples
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_pair
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.reconstruction import score_reconstruction
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset
from lidargrit.inference.samples import write_samples
from lidargrit.nn.devices import usable_device
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.training import check_folder, train
from lidargrit.training.fine_tuning import divided
from lidargrit.training.log import LOG_FILE, read_log
from lidargrit.training.measure import measure
from lidargrit.viewer import plot_comparison
from lidargrit.viewer.demo_page import DemoPage, reconstructed, write_demo_page

PAGE, PICTURE, TIMINGS = "demo.html", "scans_reconstructed_generated.png", "timings.json"
_NUM_SAMPLES = 32
_MAX_SCANS = 400  # of the user's: more would not be seen in the demo's few minutes
# Seconds for each scan on two cores without 16-bit instructions, to estimate the time before anything was measured.
_SIMULATED_S, _READ_S, _SAMPLED_S, _SCORED_S = 0.3, 0.1, 1.2, 0.8
# A pixel decoder that was trained for a minute is unsure of every range: sharper than by default, the ground is smooth.
_SHARPER = TokenSampling(range_temperature=0.1, range_noise=0.2)
_DEFAULT = TokenSampling()
_STAGES = {"tokenizer": "the tokenizer", "transformer": "the transformer", "pixels": "the pixel decoder"}


def demo(data: str | None, folder: Path, settings: list[str], anew: bool = False) -> Path:
    """Run everything on simulated or on the user's scans, and return the folder of the results.

    On simulated scans, the transformer of the model in the package is trained further for a minute; on the user's scans
    all networks of that model. Where its rays are not those of the scans, all are trained anew.

    Args:
        data: a folder of scans or another source; None for simulated scans.
        folder: run folder, which also gets ``demo.html``, ``samples``, ``evaluation.json`` and two pictures.
        settings: changed settings of the preset, as ``--set`` takes them.
        anew: whether all networks are trained anew, instead of beginning with those of the model in the package.
    """
    preset = _preset(data, settings, anew)
    check_folder(folder, preset)
    reporting.message(how_trained(preset))
    reporting.message("timing some steps of training")
    expected_s = _expected_s(preset, simulates=data is None)
    minutes = max(1, round(sum(expected_s.values()) / 60))
    about = f"about {minutes} minute{'s' if minutes > 1 else ''} on this machine"
    reporting.message(f"lidargrit demo: {about}; stop it at any time, the same command goes on")
    reporting.expect(expected_s)
    clock = _Clock(folder / TIMINGS)
    with clock.stage("read the scans and project them" if data else "simulate scans and project them"):
        real = load_range_images(preset.data.train, preset.data)
        val = load_range_images(preset.data.val, preset.data)
    generator = train(preset, folder)
    clock.keep()
    for stage in _trained_stages(preset):
        clock.add(f"train the {stage}", _trained_s(folder / stage / LOG_FILE))
    sampling = _sampling(preset)
    with clock.stage(f"sample {_NUM_SAMPLES} new scans"):
        generator.to(usable_device(""))
        write_samples(generator, folder, folder / "samples", range(_NUM_SAMPLES), sampling)
        generator.to("cpu")  # where the images of the pages and pictures are
    samples = read_samples(folder / "samples", _NUM_SAMPLES)
    with clock.stage("score reconstruction and new scans"):
        reconstruction = score_reconstruction(generator.get_tokenizer(), val)
        card = _score(samples, val)
    write_json(
        folder / "evaluation.json",
        {"reconstruction_on_val": asdict(reconstruction), "generated_against_val": card.to_json()},
    )
    reporting.message(
        f"reconstruction of {reconstruction.num_scans} scans never trained on: range error "
        f"{reconstruction.range_mae_m:.2f} m, mask accuracy {reconstruction.mask_accuracy:.3f}, dropped rays found "
        f"{reconstruction.drop_recall:.2f} with precision {reconstruction.drop_precision:.2f}"
    )
    reporting.message(card.as_table())
    reporting.message(
        "(scores after a few minutes of training on little data; they cannot be compared with published tables)"
    )
    kind = "real" if data else "simulated"
    _plot_pictures(generator, kind, val, samples, sampling, folder)
    scans = f"{len(real):,} {kind} scans to learn from and {len(val):,} held out, of the sensor {generator.sensor.name}"
    facts = _facts(preset, generator, scans)
    page = DemoPage(generator, kind, real, val, samples, reconstruction, card, clock.seconds, facts, folder, sampling)
    write_demo_page(page, folder / PAGE)
    return folder


def _facts(preset: Preset, generator: Generator, scans: str) -> tuple[str, ...]:
    """Return short sentences about the model and its training, with one about the scans."""
    weights = sum(weight.numel() for weight in generator.parameters()) / 1e6
    facts = (how_trained(preset), f"LidarGRIT at a small size: {weights:.1f} million weights", scans)
    if _sampling(preset) == _DEFAULT:
        return facts
    return (
        *facts,
        f"ranges sampled sharper than by default (range_temperature={_SHARPER.range_temperature}, "
        f"range_noise={_SHARPER.range_noise}), because so little training leaves them uncertain",
    )


def how_trained(preset: Preset) -> str:
    """Return which networks the demo trains anew, trains further and takes as they are, in a sentence for each."""
    stages = _trained_stages(preset)
    further = [stage for stage in stages if preset.training[stage].start]
    sentences = (
        ([stage for stage in _STAGES if stage not in stages], "comes", "come", "as trained, from {package}"),
        (further, "learns", "learn", "further here, from the weights of {package}"),
        ([stage for stage in stages if stage not in further], "learns", "learn", "anew here"),
    )
    package = "the model in the package, which learned from simulated streets for hours of one core"
    said = []
    for which, one, several, what in sentences:
        if which:
            *others, last = [_STAGES[stage] for stage in which]
            subject = f"{', '.join(others)} and {last}" if others else last
            verb = several if others else one
            said.append(f"{subject[0].upper()}{subject[1:]} {verb} {what.format(package=package)}.")
            package = "that model"
    return " ".join(said)


def _preset(data: str | None, settings: list[str], anew: bool) -> Preset:
    """Return the preset that suits the scans: from the model in the package, if that is wanted and has their rays."""
    config = None if data is None else divided(data, _MAX_SCANS)

    def preset_of(name: str) -> Preset:
        preset = load_preset(name)
        return override(preset if config is None else replace(preset, data=config), settings)

    if not anew:
        preset = preset_of("lidargrit_demo_transformer" if config is None else "lidargrit_demo_fine_tuned")
        if preset.data.load_sensor().same_rays(read_config(locate(PRETRAINED)).sensor):
            return preset
        reporting.message("the model in the package is of another sensor or image size, so all is trained anew")
    return preset_of("lidargrit_demo_pixels")


def _trained_stages(preset: Preset) -> list[str]:
    return [stage for stage in _STAGES if stage in preset.training and not preset.training[stage].frozen]


def _sampling(preset: Preset) -> TokenSampling:
    """Return how new scans are sampled: sharper where the pixel decoder was trained anew."""
    return _DEFAULT if preset.training["pixels"].start else _SHARPER


def _expected_s(preset: Preset, simulates: bool) -> dict[str, float]:
    """Return the expected time of each long step of the demo, in seconds; that of training from steps timed here."""
    scans = _MAX_SCANS
    if simulates:
        scans = sum(len(open_source(source).scans()) for source in (*preset.data.train, *preset.data.val))
    return {
        "projecting scans": scans * (_SIMULATED_S if simulates else _READ_S),
        **{f"training {stage.stage}": stage.seconds for stage in measure(preset)},
        "sampling": _NUM_SAMPLES * _SAMPLED_S,
        "scoring": _NUM_SAMPLES * _SCORED_S,
    }


def _score(samples: RangeImages, val: RangeImages) -> Scorecard:
    count = min(len(samples), len(val))

    def some(name: str, images: RangeImages) -> EvalSet:
        return EvalSet(name, images, evenly_spaced(count, len(images)))

    pair = EvalPair(some("samples", samples), some("held-out scans", val))
    return evaluate_pair(pair, EvalConfig(pixel_statistics=True))


_INTERRUPTED = " (interrupted)"  # end of the name of a stage that is not done yet, with the time that it took so far


class _Clock:
    """The time that each stage took until it was done, kept in a file: the same command does no stage again.

    Stages that were interrupted keep the time that they had taken. The file is written once a run lies beside it,
    because a folder that holds anything else is refused.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.seconds: dict[str, float] = read_json(path) if path.is_file() else {}
        if not all(type(seconds) in (int, float) for seconds in self.seconds.values()):
            raise CheckpointError(f"{path} with times that are no numbers", "seconds by stage", "remove the file")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begun, ended = time.monotonic(), False
        try:
            yield
            ended = True
        finally:
            took = time.monotonic() - begun + self.seconds.pop(name + _INTERRUPTED, 0.0)
            self.add(name if ended or name in self.seconds else name + _INTERRUPTED, took)
            self.keep()

    def add(self, name: str, seconds: float) -> None:
        self.seconds.setdefault(name, round(seconds, 1))

    def keep(self) -> None:
        if (self._path.parent / RUN_FILE).is_file():
            write_json(self._path, self.seconds)


def _trained_s(log: Path) -> float:
    """Return the training time of a stage by its log, whose clock starts at 0 whenever training goes on."""
    before, total = 0.0, 0.0
    for entry in read_log(log):
        seconds = float(entry["seconds"])
        total += seconds - before if seconds >= before else seconds
        before = seconds
    return total


def _plot_pictures(
    generator: Generator, kind: str, val: RangeImages, samples: RangeImages, sampling: TokenSampling, folder: Path
) -> None:
    real = val.batch(evenly_spaced(3, len(val)))
    title = f"{kind} scans never trained on, what the tokens keep of them, and new scans"
    plot_comparison(
        {kind: real, "reconstructed": reconstructed(generator, real, sampling), "generated": samples.batch(range(3))},
        folder / PICTURE,
        title=title,
    )
    plot_comparison({"generated": samples.batch(range(3, 11))}, folder / "generated.png", title="generated scans")
