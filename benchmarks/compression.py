"""Bits a return of `lidargrit compress` beside codecs of pictures and of bytes, on the same pixels → a Markdown table.

    python benchmarks/compression.py simulated:16:test kitti_odometry:/data/kitti:test -n 20 --json compression.json

All codecs get the same 16-bit picture of a range image: its ranges in whole steps, 0 where there is no return. Draco
gets the points of that image, and keeps neither their order nor their pixels: its grid has cells of one step along
every axis. Each scan is compressed by itself; what a file for many scans adds is not counted. JPEG XL needs
`pip install imagecodecs`, Draco `pip install DracoPy`. `--ideal` counts the bits that the model tells, without coding.

    python benchmarks/compression.py kitti_odometry:/data/kitti:00 -n 2 --steps-mm 20 --whole

takes whole clouds: Draco and `compress --points` get all points; a model gets the image of all columns that the sensor
fires, as one image for each column of its stride, with as many bits a point of that image, which is said to miss some
points and move others.
"""

import argparse
import io
import lzma
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16
from numcodecs import Zstd
from PIL import Image
from scipy.spatial import KDTree

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.files import write_json
from lidargrit.data.datasets import open_dataset
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_images
from lidargrit.evaluation.intervals import Estimate
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.presets import load_preset
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.inference.compress.point_codec import Cloud, PointCodec
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import SensorModel
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


def of_points(points: Float[np.ndarray, "n 3"], step_mm: int) -> bytes:
    """Return points by Draco in cells of one step: its quantisation is half a step off at most, along each axis."""
    import DracoPy  # noqa: PLC0415  not one of ours

    low, step_m = points.min(0), step_mm / 1000
    bits = int(np.ceil(np.log2((points.max(0) - low).max() / step_m + 1)))
    extent_m = (2**bits - 1) * step_m
    how = {"quantization_bits": bits, "quantization_range": extent_m, "quantization_origin": low}
    return bytes(DracoPy.encode(points, compression_level=10, **how))


def whole_clouds(source: str, models: dict[str, Generator], sensor: SensorModel, step_mm: int, count: int) -> None:
    """Print bits a point of whole clouds by Draco and by models, and what images of all columns do to the points."""
    dataset, bits = open_dataset(source), dict[str, list[float]]()
    points, returns, apart_m = list[int](), list[int](), list[np.ndarray]()
    codecs_of_models = {name: ScanCodec(model, step_mm) for name, model in models.items()}
    seconds, every = 0.0, ("Draco, all points", "compress --points, all points")
    for index in evenly_spaced(count, len(dataset)):
        scan = dataset.scan(index)
        image = project(scan, sensor.fine())
        parts = [
            RangeImage(image.range_m[:, first :: sensor.column_stride], kept, sensor)
            for first in range(sensor.column_stride)
            for kept in [image.return_mask[:, first :: sensor.column_stride]]
        ]
        xyz_m, on_rays_m = scan.points_xyz_m.numpy(), unproject(image).points_xyz_m.numpy()
        bits.setdefault(every[0], []).append(8.0 * len(of_points(xyz_m, step_mm)))
        begun = time.process_time()
        bits.setdefault(every[1], []).append(8.0 * len(PointCodec(step_mm).compress(Cloud(xyz_m, None))))
        seconds += time.process_time() - begun
        bits.setdefault("Draco, points of the image", []).append(8.0 * len(of_points(on_rays_m, step_mm)))
        for name, codec in codecs_of_models.items():
            bits.setdefault(name, []).append(8.0 * sum(len(codec.compress(part)) for part in parts))
        points.append(len(scan))
        returns.append(int(image.return_mask.sum()))
        apart_m.append(KDTree(on_rays_m).query(xyz_m)[0])
    for name, sizes in bits.items():
        per = Estimate.of_ratio(sizes, points if name in every else returns)
        print(f"| {source} | {len(points)} | {step_mm} mm | {name} | {per.as_text('.2f')} |", flush=True)
    print(f"compress --points takes {seconds / len(points):.1f} s a scan")
    middle, most = np.quantile(np.concatenate(apart_m), (0.5, 0.95))
    print(f"image: {sum(returns) / sum(points):.3f} of the points; a point of the file has one of it within")
    print(f"{100 * middle:.1f} cm in the median, and within {100 * most:.1f} cm in 95 % of all cases")


def measure(
    images: RangeImages, steps: RangeSteps, models: dict[str, Generator], ideal: bool
) -> dict[str, tuple[Estimate, float]]:
    """Return bits a return and seconds a scan, by the name of the codec."""
    codec_of_models = {} if ideal else {name: ScanCodec(model, steps.step_mm) for name, model in models.items()}
    of_image = draco()
    bits: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}
    returns = []
    for index in range(len(images)):
        image = images.batch([index])[0]
        picture = steps.indices(image.range_m).where(image.return_mask, 0).numpy().astype(np.uint16)
        every: dict[str, Bytes] = {
            name: lambda _, image=image, codec=codec: codec.compress(image) for name, codec in codec_of_models.items()
        }
        if of_image:
            every["Draco"] = lambda _, image=image, encode=of_image: encode(image, steps.step_mm)
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
    parser.add_argument("--whole", action="store_true", help="whole clouds, by models and by Draco alone")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    models, rows = {name: load(name).eval() for name in options.models}, []
    sensor = load_preset(options.sensor).data.load_sensor() if options.sensor else next(iter(models.values())).sensor
    for source in options.sources:
        if options.whole:
            for step_mm in options.steps_mm:
                whole_clouds(source, models, sensor, step_mm, options.max_scans)
            continue
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
