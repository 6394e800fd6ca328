"""Bits a return of `lidargrit compress` beside codecs of pictures and of bytes, on the same pixels → a Markdown table.

    python benchmarks/compression.py simulated:16:test kitti_odometry:/data/kitti:test -n 20 --json compression.json

All codecs get the same 16-bit picture of a range image: its ranges in whole steps, 0 where there is no return. Each
scan is compressed by itself; what a file for many scans adds is not counted. JPEG XL needs `pip install imagecodecs`.
"""

from __future__ import annotations

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

from lidargrit.compression.scan_codec import ScanCodec
from lidargrit.evaluation.estimates import Estimate
from lidargrit.files import write_json
from lidargrit.generators import load
from lidargrit.loading import DataConfig, RangeImages
from lidargrit.sources import open_images

Picture = UInt16[np.ndarray, "H W"]
Bytes = Callable[[Picture], bytes]
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


def measure(images: RangeImages, codec: ScanCodec) -> dict[str, tuple[Estimate, float]]:
    """Return bits a return and seconds a scan, by the name of the codec."""
    bits: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}
    returns = []
    for index in range(len(images)):
        image = images.batch([index])[0]
        picture = codec.steps.indices(image.range_m).where(image.return_mask, 0).numpy().astype(np.uint16)
        ours: dict[str, Bytes] = {"lidargrit": lambda _, image=image: codec.compress(image)}
        for name, compress in {**ours, **codecs()}.items():
            begun = time.process_time()
            size = len(compress(picture))
            seconds[name] = seconds.get(name, 0.0) + time.process_time() - begun
            bits.setdefault(name, []).append(8.0 * size)
        returns.append(float(image.return_mask.sum()))
    return {name: (Estimate.of_ratio(bits[name], returns), seconds[name] / len(images)) for name in bits}


def main() -> None:
    """Measure every source at every step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--model", default="pretrained")
    parser.add_argument("--steps-mm", nargs="+", type=int, default=[2, 10, 20])
    parser.add_argument("-n", "--max-scans", type=int, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    generator, rows = load(options.model), []
    for source in options.sources:
        images = open_images(source, generator.sensor, DataConfig(max_scans=options.max_scans))
        for step_mm in options.steps_mm:
            for name, (bits, seconds) in measure(images, ScanCodec(generator, step_mm)).items():
                row = {"source": source, "scans": len(images), "step_mm": step_mm, "codec": name}
                rows.append({**row, "bits": bits.value, "low": bits.low, "high": bits.high, "seconds": seconds})
                interval = f"{bits.value:.2f} [{bits.low:.2f}, {bits.high:.2f}]"
                print(f"| {source} | {len(images)} | {step_mm} mm | {name} | {interval} | {seconds:.2f} |", flush=True)
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
