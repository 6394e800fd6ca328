"""How often a range is near one that its neighbours suggest: true scans → share of returns, for each phase.

    python benchmarks/range_candidates.py -n 24

A pixel decoder's components begin at the candidates of earlier phases: at two interpolations and four neighbours (pairs
below), with ``surface_components`` also at four planes and four lines (surfaces), and with ``gravity_components`` at
four vertical planes and four horizontal ones, too (all). More of them are nearer by chance alone, so this bounds what
they can bring; how many bits they save is told by training.
"""

import argparse
from collections.abc import Sequence

import torch

from lidargrit.data.sources import open_images
from lidargrit.generation.pixel_decoder.pixel_phases import phases_of
from lidargrit.generation.pixel_decoder.range_candidates import RangeCandidates
from lidargrit.generation.presets import load_preset

NEAR_M = (0.03, 0.06, 0.2)
_CELL = 16  # of the first phase: lattices of 8 pixels and finer


def main(words: Sequence[str] | None = None) -> None:
    """Print one line for each phase that knows of earlier ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", default="simulated:256:val", help="source of scans (default: %(default)s)")
    parser.add_argument("-n", type=int, default=24, help="number of scans")
    choices = parser.parse_args(words)
    sensor = load_preset("lidargrit_compact_pixels").data.load_sensor()
    source = open_images(choices.scans, sensor=sensor)
    images = source.batch(range(min(choices.n, len(source))))
    v, returned = images.range_m.log1p(), images.return_mask
    print(
        f"{'distance, phase':24}",
        *(f"{f'{name}, {near} m':>18}" for name in ("pairs", "surfaces", "all") for near in NEAR_M),
    )
    for phase in phases_of(_CELL)[1:]:
        pixels = (..., *phase.pixels)
        suggest = [RangeCandidates(sensor, [phase], *parts) for parts in ((False, False), (True, False), (True, True))]
        nowhere = torch.full_like(v[pixels], 20.0)  # without any neighbour no candidate is near
        nearest_m = [_nearest_m(one(phase, v, returned, nowhere), images.range_m[pixels]) for one in suggest]
        shares = [float((one[returned[pixels]] < near).float().mean()) for one in nearest_m for near in NEAR_M]
        title = f"{phase.lattice.rows}, row {phase.row} column {phase.column}"
        print(f"{title:24}", *(f"{share:18.3f}" for share in shares), flush=True)


def _nearest_m(candidates: torch.Tensor, range_m: torch.Tensor) -> torch.Tensor:
    return (candidates.expm1() - range_m[:, None]).abs().amin(1)


if __name__ == "__main__":
    main()
