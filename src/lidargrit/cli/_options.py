"""Options that several verbs share: one wording and one meaning for each."""

from __future__ import annotations

import argparse


def add_bad_points(parser: argparse.ArgumentParser) -> None:
    """Add ``--bad-points``."""
    parser.add_argument(
        "--bad-points",
        choices=["refuse", "drop"],
        default="refuse",
        help="how to treat points that are NaN, infinite or at the origin: refuse the scan, or drop the points",
    )


def add_bad_scans(parser: argparse.ArgumentParser) -> None:
    """Add ``--bad-points`` and ``--bad-scans``."""
    add_bad_points(parser)
    parser.add_argument(
        "--bad-scans",
        choices=["refuse", "skip"],
        default="refuse",
        help="how to treat a scan that cannot be used: stop, or skip the scan with a warning",
    )


def add_settings(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--set NAME=VALUE ...``, which changes settings of ``what``."""
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=what)


def add_projection_variant(parser: argparse.ArgumentParser, *aliases: str, default: str | None = "exact") -> None:
    """Add ``--projection-variant``."""
    variant = "exact, or reference to repeat the projection of the released LidarGRIT program"
    words = ("--projection-variant", *aliases)
    parser.add_argument(*words, choices=["exact", "reference"], default=default, help=variant)


def add_rank(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--rank`` and ``--world-size`` of ``what`` shares the work: process or machine."""
    rank = f"number of this {what}, from 0, if several share the work (default: $RANK, or 0)"
    parser.add_argument("--rank", type=int, help=rank)
    size = "how many share the work (default: $WORLD_SIZE, or 1); torchrun sets both"
    parser.add_argument("--world-size", type=int, help=size)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--device``."""
    device = "device to compute on: cpu, cuda or cuda:1 (default: cuda if there is one)"
    parser.add_argument("--device", default="", help=device)
