"""A generator that takes a past, and a way → generated scans in a row, each given the last ones, as KITTI sequences."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.core.files import sha256_of_json
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.run_folder import locate
from lidargrit.data.scan_folder import KittiTree, ScanFolder, ScanIdentity
from lidargrit.data.sources import open_source
from lidargrit.data.trajectories import read_trajectory
from lidargrit.data.windows import drives_in
from lidargrit.generation.generator import Generator, SamplingT, load
from lidargrit.inference.samples import sampling_identity
from lidargrit.scans.condition import NOTHING, Condition
from lidargrit.scans.fine_columns import in_fine_columns
from lidargrit.scans.motion import Motion, as_poses, transform_between
from lidargrit.scans.past import Past
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.types import RangeImage, Scan

MANIFEST = "drive.json"
PERIOD_S, _SPEED_M_S = 0.1, 10.0  # of a drive from nothing
_DIGITS = 6  # of metres and seconds behind the point, in which all machines agree

Pose = Float64[Tensor, "4 4"]


class Seen(NamedTuple):
    """A scan before those that are generated.

    Args:
        range_m: ranges in all fine columns of the sensor, in metres, 0 where nothing returned.
        pose: matrix from the sensor's frame to that of the drive.
        time_s: time on the clock of the drive.
    """

    range_m: Float[Tensor, "H fine_W"]
    pose: Pose
    time_s: float


@dataclass(frozen=True, eq=False)
class Way:
    """What a drive begins with, and where its generated scans are made.

    Args:
        seen: scans before the first generated one, in order of time.
        poses: pose of each generated scan.
        begin_s: time of the first one.
        period_s: time from one to the next.
    """

    seen: Sequence[Seen]
    poses: Sequence[Pose]
    begin_s: float = 0.0
    period_s: float = PERIOD_S

    def from_first(self, pose: Pose) -> Pose:
        """Return a pose in the frame of the first generated scan."""
        return transform_between(pose, self.poses[0])

    def places(self) -> list[str]:
        """Return a hash of where and when each generated scan is made, beside the first one and those that are seen."""
        seen = [(self.from_first(one.pose), one.time_s - self.begin_s) for one in self.seen]
        made = [(self.from_first(pose), number * self.period_s) for number, pose in enumerate(self.poses)]
        numbers = [(*pose.flatten().tolist(), at_s) for pose, at_s in (*seen, *made)]
        words = [[round(each, _DIGITS) + 0.0 for each in some] for some in numbers]
        before, own = words[: len(seen)], words[len(seen) :]
        return [sha256_of_json([before, each])[:12] for each in own]


def path_of(frames: int, path: Path | None = None) -> Way:
    """Return a way of a drive from nothing: along the poses of a file or KITTI sequence, or 10 m/s straight ahead.

    Args:
        path: file or folder for :func:`lidargrit.data.trajectories.read_trajectory`; None for a straight way.
    """
    if frames < 1:
        raise ConfigError(f"--frames {frames}", "at least 1", "raise it")
    if path is None:
        poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
        poses[:, 0, 3] = torch.arange(frames) * (_SPEED_M_S * PERIOD_S)
        return Way((), [*poses])
    known = read_trajectory(path)
    times_s = known.times_s[0] + PERIOD_S * np.arange(frames)
    if not known.covers(times_s):
        lasts = known.times_s[-1] - known.times_s[0]
        got = f"{frames} scans, {PERIOD_S:g} s apart, along {path}, which lasts {lasts:.1f} s"
        raise ConfigError(got, "no more than its length", f"take --frames {int(lasts / PERIOD_S) + 1}, or another path")
    turns, places = known.at(times_s)
    return Way((), [*torch.from_numpy(as_poses(turns.as_matrix(), places))])


def continued(drive: str, generator: Generator[Any, Any], frames: int, after: int | None, constant_speed: bool) -> Way:
    """Return the way on from a scan of a recorded drive.

    Args:
        drive: source of scans with times and poses; the last of its drives counts.
        generator: generator of the scans to come, whose sensor and number of past scans decide what is seen.
        frames: number of scans to come.
        after: number of the last scan that is seen, from 0; the last one of the drive if not given.
        constant_speed: whether later poses of the drive are left alone. Where it has none, the last step is repeated.
    """
    dataset = open_source(drive).scans()
    scans = dataset.timed_scans()
    numbers = max(drives_in(scans), key=lambda one: (len(one) > 1, one[-1:]), default=[])
    if len(numbers) < 2:
        got = f"{drive} with {counted_scans(len(numbers))} that have times and poses"
        raise DataError(got, "at least two in a row", "put times.txt and poses.txt beside them")
    last = len(numbers) - 1 if after is None else after
    if not 1 <= last < len(numbers):
        got = f"{drive} with {len(numbers)} scans in a row that have times and poses, and --after {last}"
        raise DataError(got, "two scans before the first forecast", f"--after 1 to {len(numbers) - 1}")
    motions = [scans[number].motion for number in numbers]
    times_s = [motion.time_s or 0.0 for motion in motions]
    known = [motion.pose for motion in motions if motion.pose is not None]  # all of a drive's have one
    first = max(0, last + 1 - generator.past_scans)
    fine = generator.sensor.fine()
    seen = [
        Seen(project(dataset.scan(numbers[at]), fine).range_m, known[at], times_s[at]) for at in range(first, last + 1)
    ]
    poses = known[: last + 1] if constant_speed else known[: last + 1 + frames]
    step = transform_between(poses[-1], poses[-2])
    while len(poses) < last + 1 + frames:
        poses.append(poses[-1] @ step)
    period_s = (times_s[-1] - times_s[0]) / (len(times_s) - 1)
    return Way(seen, poses[last + 1 :], times_s[last] + period_s, period_s)


def opening_of(name: str | Path, device: str = "cpu") -> Generator[Any, Any] | None:
    """Return the generator of first scans of drives: of a bundle with a run for drives the one that samples."""
    return load(locate(name), device=device) if locate(name) != locate(name, "drive") else None


def write_drives(
    generator: Generator[Any, SamplingT],
    run_folder: Path,
    out: Path,
    ways: Sequence[Way],
    seeds: Sequence[int],
    sampling: SamplingT | None = None,
    first: Generator[Any, Any] | None = None,
    **facts: str | int | bool | None,
) -> int:
    """Write a sequence of generated scans for each way, at bounded memory; scans that are there are kept.

    A scan is given those written before it, as their files hold them, so that a drive that was stopped goes on to the
    same files. They lie in ``sequences/SS/velodyne/NNNNNN.bin`` with ``poses.txt``, ``times.txt`` and ``calib.txt``.

    Args:
        run_folder: folder that the generator was read from.
        first: generator of a drive's first scan, where none is seen before it; the same one if not given.
        facts: entries of the manifest by which the ways are told from others.

    Returns:
        Number of scans that are there now.
    """
    if not generator.past_scans:
        got = f"a model of {generator.public_name()!r}, which takes no past"
        raise ConfigError(got, "a model of drives", "train one: lidargrit train forecaster_compact OUT")
    settings = generator.Sampling() if sampling is None else sampling
    opening = generator if first is None else first
    if not opening.sensor.same_rays(generator.sensor):
        got = f"first scans of the sensor {opening.sensor.name!r}, {opening.sensor.height}x{opening.sensor.width}"
        raise ConfigError(got, f"those of {generator.sensor.name!r}", "name a run of that sensor")
    names = [f"{drive:02d}/{frame:06d}" for drive, way in enumerate(ways) for frame in range(len(way.poses))]
    identities = [
        ScanIdentity(f"seed {seed}, frame {frame}, {place}")
        for seed, way in zip(seeds, ways, strict=True)
        for frame, place in enumerate(way.places())
    ]
    identity = {"source": str(run_folder), **facts, **sampling_identity(generator, run_folder, settings)}
    tree = KittiTree(out)
    files = tree.files(names)
    folder = ScanFolder(out, MANIFEST, identity, files, identities)
    with folder.writing("sampling") as progress:
        folder.tell_sensor(generator.sensor)
        for drive, (way, seed) in enumerate(zip(ways, seeds, strict=True)):
            own = [file for file in files if file.startswith(f"sequences/{drive:02d}/")]
            places = map(way.from_first, way.poses)
            tree.write_motions(own, [Motion(number * way.period_s, pose) for number, pose in enumerate(places)])
            sequence = out / "sequences" / f"{drive:02d}"
            _Drive(generator, opening, way, seed, sequence, settings).write(progress)
    return folder.num_written


class _Drive:
    """Writes the scans of one drive.

    Args:
        opening: generator of a scan before which there is none.
    """

    def __init__(
        self,
        generator: Generator[Any, SamplingT],
        opening: Generator[Any, Any],
        way: Way,
        seed: int,
        folder: Path,
        sampling: SamplingT,
    ) -> None:
        self._opening, self._generator, self._way, self._seed, self._sampling = opening, generator, way, seed, sampling
        self._files = [folder / "velodyne" / f"{frame:06d}.bin" for frame in range(len(way.poses))]

    def write(self, progress: reporting.Progress) -> None:
        way, missing = self._way, [not file.exists() for file in self._files]
        if not any(missing):
            return
        past_scans = self._generator.past_scans
        begin = max(0, missing.index(True) - past_scans)
        seen = deque([] if begin else way.seen, past_scans)
        for frame in range(begin, len(self._files)):
            time_s = way.begin_s + frame * way.period_s
            if missing[frame]:
                seeds, past = [scan_seed(self._seed, frame)], self._past(seen, way.poses[frame], time_s)
                opens = past is NOTHING and self._opening is not self._generator
                images = self._opening.sample(seeds) if opens else self._generator.sample(seeds, past, self._sampling)
                KittiBin.write(self._files[frame], _as_fired(images[0].to("cpu")))
                progress.advance(1)
            seen.append(Seen(self._written(self._files[frame]), way.poses[frame], time_s))

    def _past(self, seen: Sequence[Seen], pose: Pose, time_s: float) -> Condition:
        if not seen:
            return NOTHING
        range_m = torch.stack([one.range_m for one in seen])[None]
        transforms = torch.stack([transform_between(one.pose, pose) for one in seen])[None]
        ages_s = torch.tensor([[time_s - one.time_s for one in seen]], dtype=torch.float64)
        return Past(range_m, transforms, ages_s, self._generator.sensor)

    def _written(self, file: Path) -> Float[Tensor, "H fine_W"]:
        image = project(KittiBin.read(file), self._generator.sensor, "spherical")
        return in_fine_columns(RangeImage.stack([image]))[0]


def _as_fired(image: RangeImage) -> Scan:
    """Return the points of an image as KITTI's files have them: ring by ring, each counter-clockwise from ahead."""
    scan = unproject(image)
    assert scan.ring is not None  # which unproject tells
    x, y = scan.points_xyz_m[:, :2].double().unbind(1)
    turn = (torch.atan2(y, x) / (2 * math.pi)).remainder(1)
    order = (scan.ring + turn).argsort(stable=True)
    return Scan(scan.points_xyz_m[order], ring=scan.ring[order], source=scan.source)
