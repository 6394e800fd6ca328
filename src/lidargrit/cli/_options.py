"""Options that several verbs share: one wording and one meaning for each."""

import argparse
from collections.abc import Collection
from typing import TYPE_CHECKING

from lidargrit.core.errors import ConfigError

if TYPE_CHECKING:
    from lidargrit.data.prepared.config import ScanSettings

SCANS = ("sensor", "projection", "projection_variant", "bad_points", "bad_scans", "set")
"""Names of the options of :func:`add_scans`."""
_ALWAYS = ("out", "json", "overwrite", "help", "debug")  # in every mode of a verb that has several


def add_bad_points(parser: argparse.ArgumentParser, default: str | None = "refuse") -> None:
    """Add ``--bad-points``."""
    parser.add_argument(
        "--bad-points",
        choices=["refuse", "drop"],
        default=default,
        help="how to treat points that are NaN, infinite or at the origin: refuse the scan, or drop the points",
    )


def add_bad_scans(parser: argparse.ArgumentParser, default: str | None = "refuse") -> None:
    """Add ``--bad-points`` and ``--bad-scans``."""
    add_bad_points(parser, default)
    parser.add_argument(
        "--bad-scans",
        choices=["refuse", "skip"],
        default=default,
        help="how to treat a scan that cannot be used: stop, or skip the scan with a warning",
    )


def add_scans(
    parser: argparse.ArgumentParser,
    settings: str = "settings of reading scans, the same for all verbs, such as data.columns=1024",
) -> None:
    """Add the options of all verbs that read and project scans; :func:`scan_settings` reads them."""
    sensor = "name or .json file of the sensor (default: that of the data set, the samples, the run or the protocol)"
    parser.add_argument("--sensor", default="", help=sensor)
    rows = "rows by elevation (spherical), by ring (unfolding), or the sensor's own (default), by elevation where "
    rows += "points are not in firing order"
    parser.add_argument("--projection", choices=["sensor", "spherical", "unfolding"], help=rows)
    variant = "exact, or reference to repeat the projection of the released LidarGRIT program"
    parser.add_argument("--projection-variant", choices=["exact", "reference"], help=variant)
    add_bad_scans(parser, default=None)
    add_settings(parser, settings)


def scan_settings(options: argparse.Namespace, **more: int | None) -> "ScanSettings":
    """Return the settings of reading scans that the user gave.

    Args:
        options: parsed options of a verb to which :func:`add_scans` was applied.
        more: further settings of :class:`DataConfig` that the verb has options for; None for those not given.
    """
    from lidargrit.data.prepared.config import ScanSettings

    names = ("sensor", "projection", "projection_variant", "bad_points", "bad_scans")
    return ScanSettings.read(options.set, **{name: vars(options).get(name) for name in names}, **more)


def add_settings(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--set NAME=VALUE ...``, which changes settings of ``what``."""
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=what)


def add_rank(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--rank`` and ``--world-size``, for work that several processes or machines (``what``) share."""
    rank = f"number of this {what}, from 0, if several share the work (default: $RANK, or 0)"
    parser.add_argument("--rank", type=int, help=rank)
    size = "how many share the work (default: $WORLD_SIZE, or 1); torchrun sets both"
    parser.add_argument("--world-size", type=int, help=size)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--device``."""
    device = "device to compute on: cpu, cuda or cuda:1 (default: cuda if there is one)"
    parser.add_argument("--device", default="", help=device)


def refuse_unused(options: argparse.Namespace, when: str, takes: Collection[str]) -> None:
    """Refuse words that a verb does not take in one of its modes.

    Args:
        options: parsed options of the verb.
        when: words for the mode, such as "with --tables".
        takes: names of what it takes then.

    Raises:
        ConfigError: another option or word is given; names the first.
    """
    for action in options.words._actions:
        given = getattr(options, action.dest, action.default) != action.default
        if given and action.dest not in (*takes, *_ALWAYS):
            name = action.option_strings[-1] if action.option_strings else getattr(options, action.dest)
            word = " ".join(name) if isinstance(name, list) else name
            raise ConfigError(
                f"{word} {when}", "only what is used then", f"leave it out, see: {options.words.prog} --help"
            )
