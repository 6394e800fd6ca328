"""Bits a return of `lidargrit compress` beside codecs of pictures and of bytes, on the same pixels → a Markdown table.

    python benchmarks/compression.py simulated:16:test kitti_odometry:/data/kitti:test -n 20 --json compression.json

All codecs get the same 16-bit picture of a range image: its ranges in whole steps, 0 where there is no return. Draco
gets the points of that image, and keeps neither their order nor their pixels: its grid has cells of one step along
every axis. Each scan is compressed by itself; what a file for many scans adds is not counted. JPEG XL needs
`pip install imagecodecs`, Draco `pip install DracoPy`. `--ideal` counts the bits that the model tells, without coding.
"""

import argparse
import io
import lzma
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt16
from numcodecs import Zstd
from PIL import Image

from lidargrit.core.files import write_json
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_images
from lidargrit.evaluation.intervals import Estimate
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.presets import load_preset
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.scans.projection import unproject
from lidargrit.scans.types import RangeImage

Picture = UInt16[np.ndarray, "H W"]
Bytes = Callable[[Picture], bytes]
_DRACO_BITS = 17  # cells of 2 mm over 262 m; coarser ones over more
_DELTA = [{"id": lzma.FILTER_DELTA, "dist": 2}, {"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME}]


def png(picture: Picture) -> bytes:
    """Return a 16-bit PNG."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", optimize=True)
    return file.getvalue()


def codecs() -> dict[str, Bytes]:
    """Return the codecs of other programs, each at the effort at which files are smallest."""
    found: dict[str, Bytes] = {
        "PNG": png,
        "zstd": lambda picture: bytes(Zstd(level=22).encode(picture.tobytes())),
        "differences + LZMA": lambda picture: lzma.compress(picture.tobytes(), lzma.FORMAT_RAW, filters=_DELTA),
    }
    try:
        import imagecodecs  # noqa: PLC0415  not one of ours
    except ImportError:
        return found
    return {**found, "JPEG XL": lambda picture: bytes(imagecodecs.jpegxl_encode(picture, lossless=True, effort=9))}


def draco() -> Callable[[RangeImage, int], bytes] | None:
    """Return Draco at its highest effort, if it is installed."""
    try:
        import DracoPy  # noqa: PLC0415  not one of ours
    except ImportError:
        return None

    def encode(image: RangeImage, step_mm: int) -> bytes:
        step_m = step_mm / 1000
        bits = next(bits for bits in range(8, _DRACO_BITS + 1) if 2**bits * step_m >= 2 * image.sensor.range_max_m)
        extent_m = (2**bits - 1) * step_m
        points = unproject(image).points_xyz_m.numpy().astype(np.float32)
        return bytes(
            DracoPy.encode(
                points,
                quantization_bits=bits,
                compression_level=10,
                quantization_range=extent_m,
                quantization_origin=np.full(3, -extent_m / 2),
            )
        )

    return encode


def measure(
    images: RangeImages, steps: RangeSteps, models: dict[str, Generator], ideal: bool
) -> dict[str, tuple[Estimate, float]]:
    """Return bits a return and seconds a scan, by the name of the codec."""
    codec_of_models = {} if ideal else {name: ScanCodec(model, steps.step_mm) for name, model in models.items()}
    of_points = draco()
    bits: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}
    returns = []
    for index in range(len(images)):
        image = images.batch([index])[0]
        picture = steps.indices(image.range_m).where(image.return_mask, 0).numpy().astype(np.uint16)
        every: dict[str, Bytes] = {
            name: lambda _, image=image, codec=codec: codec.compress(image) for name, codec in codec_of_models.items()
        }
        if of_points:
            every["Draco"] = lambda _, image=image, encode=of_points: encode(image, steps.step_mm)
        for name, compress in {**every, **codecs()}.items():
            begun = time.process_time()
            size = len(compress(picture))
            seconds[name] = seconds.get(name, 0.0) + time.process_time() - begun
            bits.setdefault(name, []).append(8.0 * size)
        for name, model in models.items() if ideal else ():
            begun = time.process_time()
            told = model.bits(RangeImage.stack([image]), steps.step_mm)
            seconds[name] = seconds.get(name, 0.0) + time.process_time() - begun
            evenly = told.tokens.numel() * np.log2(model.get_tokenizer().num_codes) if told.tokens.numel() > 1 else 0.0
            bits.setdefault(name, []).append(float(told.total()) - float(told.tokens.sum()) + evenly)
        returns.append(float(image.return_mask.sum()))
    return {name: (Estimate.of_ratio(bits[name], returns), seconds[name] / len(images)) for name in bits}


def main() -> None:
    """Measure every source at every step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--models", nargs="*", default=["pretrained"])
    parser.add_argument("--sensor", help="preset of whose sensor the images are, where there is no model")
    parser.add_argument("--ideal", action="store_true")
    parser.add_argument("--steps-mm", nargs="+", type=int, default=[2, 10, 20])
    parser.add_argument("-n", "--max-scans", type=int, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    models, rows = {name: load(name).eval() for name in options.models}, []
    sensor = load_preset(options.sensor).data.load_sensor() if options.sensor else next(iter(models.values())).sensor
    for source in options.sources:
        images = open_images(source, sensor, DataConfig(max_scans=options.max_scans))
        for step_mm in options.steps_mm:
            found = measure(images, RangeSteps(sensor, step_mm), models, options.ideal)
            for name, (bits, seconds) in found.items():
                row = {"source": source, "scans": len(images), "step_mm": step_mm, "codec": name}
                rows.append({**row, "bits": bits.value, "low": bits.low, "high": bits.high, "seconds": seconds})
                interval = f"{bits.value:.2f} [{bits.low:.2f}, {bits.high:.2f}]"
                print(f"| {source} | {len(images)} | {step_mm} mm | {name} | {interval} | {seconds:.2f} |", flush=True)
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
