"""Options that several verbs share: one wording and one meaning for each."""

import argparse
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import WholeNumber, step_in_mm, whole_number

if TYPE_CHECKING:
    from lidargrit.data.prepared.config import ScanSettings
    from lidargrit.scans.sensors import SensorModel

SCANS = ("sensor", "projection", "bad_points", "bad_scans", "set")
"""Names of the options of :func:`add_scans`."""
_READING = "settings of reading scans, as data.columns=1024"
_ALWAYS = ("out", "json", "overwrite", "help", "debug")  # in every mode of a verb that has several


def add_scans(parser: argparse.ArgumentParser, settings: str = _READING, *, projects: bool = True) -> None:
    """Add the options of all verbs that read scans; :func:`scan_settings` or :func:`scan_words` reads them.

    Args:
        settings: words for what ``--set`` changes.
        projects: whether scans become range images, so that their sensor matters and how rows are found.
    """
    add = parser.add_argument
    if projects:
        add("--sensor", default="", help="name or .json of the scans' sensor (else guessed)")
        rows = {"choices": ["sensor", "spherical", "unfolding"], "metavar": "ROWS"}
        add("--projection", help="spherical (elevation), unfolding (ring) or sensor", **rows)
    how = {"metavar": "HOW", "default": None}
    add("--bad-points", choices=["refuse", "drop"], help="refuse or drop placeholder points (NaN, 0 0 0)", **how)
    add("--bad-scans", choices=["refuse", "skip"], help="refuse or skip scans that cannot be used", **how)
    add_settings(parser, settings)


def scan_words(options: argparse.Namespace, **more: int | None) -> list[str]:
    """Return the settings of reading scans that the user gave, as words for ``--set``; those of ``--set`` come last."""
    given = {name: vars(options).get(name) for name in SCANS if name != "set"} | more
    return [*(f"data.{name}={value}" for name, value in given.items() if value not in (None, "")), *options.set]


def scan_settings(options: argparse.Namespace, **more: int | None) -> "ScanSettings":
    """Return the settings of reading scans that the user gave.

    Args:
        options: parsed options of a verb to which :func:`add_scans` was applied.
        more: further settings of :class:`DataConfig` that the verb has options for; None for those not given.
    """
    from lidargrit.data.prepared.config import ScanSettings

    return ScanSettings.read([word for word in scan_words(options, **more) if not word.startswith("sampling.")])


def add_settings(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--set NAME=VALUE ...``, which changes settings of ``what``."""
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=what)


def sampling_words(words: Sequence[str]) -> list[str]:
    """Return the settings of sampling among those of ``--set``, without the ``sampling.`` before their names."""
    for word in words:
        if not word.startswith(("sampling.", "data.")):
            wanted = "sampling. before a setting of sampling, data. before one of reading scans"
            raise ConfigError(f"--set {word}", wanted, f"such as --set sampling.{word}")
    return [word.removeprefix("sampling.") for word in words if word.startswith("sampling.")]


def sensor_of(options: argparse.Namespace) -> "SensorModel | None":
    """Return the sensor whose scans are to be sampled, with the columns of ``--set``; None for a run's own.

    A cluster samples single scans of a run's own sensor alone.
    """
    from lidargrit.data.prepared.config import ScanSettings

    if options.path and not options.frames:
        raise ConfigError("--path without --frames", "both", "add --frames 20, or leave --path out")
    for word in ("sensor", "frames"):
        if options.ray and getattr(options, word):
            raise ConfigError(f"--{word} {getattr(options, word)} with --ray", "one of them", "leave --ray out")
    words = [word for word in options.set if word.startswith("data.")]
    return ScanSettings.read(words, sensor=options.sensor).load_sensor()


def add_count(
    parser: argparse.ArgumentParser,
    default: int = 0,
    help: str = "number of scans, evenly spaced; 0 for all",
    number: WholeNumber = whole_number,
) -> None:
    """Add ``-n``/``--count``, the number of scans."""
    parser.add_argument("-n", "--count", type=number, default=default, metavar="N", help=help)


def add_step(parser: argparse.ArgumentParser, help: str) -> None:
    """Add ``--step-mm``, the step that ranges or coordinates are rounded to, in millimetres."""
    parser.add_argument("--step-mm", type=step_in_mm, default=10, metavar="MM", help=help)


def add_rank(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--rank`` and ``--world-size``, for work that several processes or machines (``what``) share."""
    rank = f"number of this {what}, from 0, if several share the work (default: $RANK, or 0)"
    parser.add_argument("--rank", type=int, help=rank)
    size = "how many share the work (default: $WORLD_SIZE, or 1); torchrun sets both"
    parser.add_argument("--world-size", type=WholeNumber(1), help=size)


def add_ray(parser: argparse.ArgumentParser) -> None:
    """Add ``--ray``, for work that the machines of a cluster share."""
    address = "Ray cluster that does the work: auto or HOST:PORT"
    parser.add_argument("--ray", default="", metavar="ADDRESS", help=address)


def ray_address(options: argparse.Namespace) -> str:
    """Return the address of the cluster, "" for none; refuse a rank beside it."""
    if options.ray and (options.rank, options.world_size) != (None, None):
        got = f"--ray {options.ray} with --rank or --world-size"
        raise ConfigError(got, "one of them", "leave --rank and --world-size out: the cluster divides the work")
    return options.ray


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--device``."""
    device = "cpu or cuda:1 (default: a GPU, if there is one)"
    parser.add_argument("--device", default="", help=device)


def refuse_unused(options: argparse.Namespace, when: str, takes: Collection[str]) -> None:
    """Refuse words that a verb does not take in one of its modes.

    Args:
        options: parsed options of the verb.
        when: words for the mode, such as "with --protocol streets".
        takes: names of what it takes then.
    """
    for action in options.words._actions:
        given = getattr(options, action.dest, None)
        if given not in (None, [], action.default) and action.dest not in (*takes, *_ALWAYS):
            word = action.option_strings[-1] if action.option_strings else given if isinstance(given, str) else given[0]
            cure = f"leave it out, see: {options.words.prog} --help"
            raise ConfigError(f"{word} {when}", "only what is used then", cure)
