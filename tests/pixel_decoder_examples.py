"""Small sensors, and pixel decoders with what goes into them, none of whose numbers are trained."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder
from lidargrit.scans.sensors import SensorModel, SensorSetup
from lidargrit.scans.types import Decoded, RangeImage

FEATURES = 5


def tiny_sensor(rows: int, columns: int) -> SensorModel:
    elevation_rad = 0.05 - 0.4 * torch.linspace(0, 1, rows)[:, None] ** 1.2  # rows are not evenly spaced
    azimuth_rad = math.pi - 2 * math.pi * (torch.arange(columns) + 0.5)[None] / columns
    return SensorModel("tiny", elevation_rad, azimuth_rad, 1.0, 80.0, "spherical")


def write_other_sensor(folder: Path) -> None:
    """Write a sensor of 13 rows and 256 columns, ``mine.json``, and a scan of it in ``scans``."""
    mine = replace(tiny_sensor(13, 256), name="mine", setup=SensorSetup(height_m=2.0))
    (folder / "mine.json").write_text(json.dumps(mine.to_json()))
    (folder / "scans").mkdir()
    np.save(folder / "scans" / "one.npy", random_images(mine, 1).range_m[0].numpy())


def random_decoder(
    sensor: SensorModel, cell: int, spread: float = 0.3, halvings: tuple[int, int] = (0, 0), features: int = FEATURES
) -> PixelDecoder:
    """Return a decoder none of whose weights are zero, so that everything depends on everything it may."""
    torch.manual_seed(0)
    config = PixelDecoderConfig(
        cell,
        *halvings,
        mask_features=3,
        range_features=3,
        mask_width=6,
        range_width=6,
        blocks=1,
        surface_components=True,
        gravity_components=True,
    )
    decoder = PixelDecoder(config, sensor, features)
    for weight in decoder.parameters():
        weight.data = spread * torch.randn_like(weight)
    return decoder.eval()


def random_decoded(sensor: SensorModel, batch: int, seed: int = 1) -> Decoded:
    rng = torch.Generator().manual_seed(seed)
    size = (batch, sensor.height, sensor.width)
    return Decoded(
        2 + 40 * torch.rand(size, generator=rng),
        torch.randn(size, generator=rng),
        sensor,
        features=torch.randn((batch, FEATURES, *size[1:]), generator=rng),
    )


def random_images(sensor: SensorModel, batch: int, seed: int = 2) -> RangeImage:
    rng = torch.Generator().manual_seed(seed)
    size = (batch, sensor.height, sensor.width)
    return RangeImage.masked(1 + 70 * torch.rand(size, generator=rng), torch.rand(size, generator=rng) < 0.7, sensor)
