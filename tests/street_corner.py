"""One scan of a made-up street corner by a VLP-16, for tests of what readers make of it."""

import numpy as np
import torch

from lidargrit.sensors import SensorModel, load_sensor

COLUMNS = 90


def corner(seed: int = 0, sensor: SensorModel | None = None, columns: int = COLUMNS) -> dict[str, np.ndarray]:
    """Return x, y, z in metres, intensity from 35 to 234 and ring (0 = top) of each point, ring by ring."""
    sensor = (sensor or load_sensor("vlp16")).with_columns(columns)
    ray = sensor.ray_directions().double().numpy()
    rng = np.random.default_rng(seed)
    with np.errstate(divide="ignore"):
        ground = np.where(ray[..., 2] < 0, -1.8 / ray[..., 2], np.inf)
        walls = np.minimum(9 / np.abs(ray[..., 0]), (6 + seed % 5) / np.abs(ray[..., 1]))
    range_m = np.minimum(ground, walls) * rng.normal(1, 0.001, ground.shape)
    returned = rng.random(range_m.shape) < 0.95
    xyz = (ray * range_m[..., None])[returned].astype(np.float32)
    ring = np.broadcast_to(np.arange(len(range_m))[:, None], range_m.shape)[returned].astype(np.uint16)
    return {**dict(zip("xyz", xyz.T, strict=True)), "intensity": rng.integers(35, 235, len(xyz)), "ring": ring}


def xyz_of(table: dict[str, np.ndarray]) -> torch.Tensor:
    """Return the points of a table (n, 3)."""
    return torch.from_numpy(np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float32))


def rows_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return columns as rows of a structured array, each of its own type; float64 is kept."""
    table = np.zeros(len(columns["x"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def pcd_bytes(table: np.ndarray, data: str = "binary", body: bytes | None = None, **lines: str) -> bytes:
    """Return a PCD file of a structured array; a line of the header may be given, or left out by an empty one."""
    kinds = [table.dtype[name] for name in table.dtype.names]
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(table.dtype.names),
        "SIZE": " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE": " ".join(kind.kind.upper() for kind in kinds),
        "COUNT": " ".join("1" for _ in kinds),
        "WIDTH": str(len(table)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(table)),
        **lines,
        "DATA": data,
    }
    text = "".join(f"{key} {value}\n" for key, value in header.items() if value)
    return text.encode() + (table.tobytes() if body is None else body)
