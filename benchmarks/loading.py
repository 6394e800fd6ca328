"""Prepared range images: room per image, images a second in random order, memory; from simulated scans or a source.

    python benchmarks/loading.py
    python benchmarks/loading.py --source kitti_odometry:/data/kitti_odometry --images 80000

The images of the source are written over and over again until there are as many as wanted, as a stand-in for a large
data set. What the disk gives depends on what the system has cached: the second pass is from memory, if it fits.
"""

import argparse
import hashlib
import json
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

from lidargrit.core.files import write_json, write_text
from lidargrit.data.batches import Batches
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.plan import ARRAYS, PLAN_FILE, SCANS_FILE
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.prepared.workers import ShardWriter
from lidargrit.scans.sensors import load_sensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="simulated:32")
    parser.add_argument("--images", type=int, default=4096)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batch-size", type=int, default=16)
    options = parser.parse_args()
    sensor = replace(load_sensor("hdl64e_kitti_360"), projection="spherical")
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        config = DataConfig(sensor="hdl64e_kitti_360", max_scans=32)
        few = prepare(options.source, config, Path(folder) / "few", sensor=sensor)
        print(f"projected {len(PreparedImages(str(few)))} scans in {time.perf_counter() - begun:.1f} s")
        many = repeat(few, Path(folder) / "many", options.images)
        size = sum(path.stat().st_size for path in (many / ARRAYS).glob("*/c.*")) / options.images
        print(f"{options.images} images of {sensor.height}x{sensor.width}, {size / 1e3:.1f} KB each")
        before = own_mb()
        begun = time.perf_counter()
        images = RangeImages(sensor, [PreparedImages(str(many))])
        print(f"opened in {time.perf_counter() - begun:.2f} s")
        for workers in sorted({1, options.workers}):
            batches = Batches(images, options.batch_size, (), False, 0, workers=workers)
            for name in ("first pass", "second pass"):
                seen, begun = 0, time.perf_counter()
                for batch in batches.stream(0, options.images):
                    seen += len(batch)
                rate = seen / (time.perf_counter() - begun)
                print(f"{workers} workers, random order, {name}: {rate:,.0f} images a second")
        print(f"own memory, without mapped pages of files: {before:.0f} MB before, {own_mb():.0f} MB after")


def repeat(few: Path, many: Path, count: int) -> Path:
    """Write the images of a prepared folder again and again."""
    store = PreparedImages(str(few))
    spec = replace(store.spec, num_scans=count, digest=hashlib.sha256(b"repeated").hexdigest())
    many.mkdir()
    write_text(many / SCANS_FILE, json.dumps([[f"image {index}", "", 0, 0] for index in range(count)]))
    write_json(many / PLAN_FILE, asdict(spec))
    images = [RangeImages(store.sensor, [store]).batch([index])[0] for index in range(len(store))]
    begun = time.process_time()
    for shard in range(spec.num_shards):
        writer = ShardWriter(many, spec, shard)
        for index in spec.scans_of(shard):
            writer.add(index, images[index % len(images)])
        writer.keep()
    print(f"written in {(time.process_time() - begun) / count * 1e3:.2f} ms of processor time an image")
    return many


def own_mb() -> float:
    """Return what Linux counts as this process's anonymous memory: mapped files are the system's to drop."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.split("RssAnon:")[1].split()[0]) / 1024


if __name__ == "__main__":
    main()
