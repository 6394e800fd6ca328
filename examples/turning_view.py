"""A simulated scan and one that the packaged model generated, turning side by side → turning_view.webp."""

import sys
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw

import lidargrit

COUNT, WIDE, TALL, GAP = 36, 430, 300, 8  # pictures of a turn; pixels of one panel, and between the two
GROUND = (11, 15, 19)  # dark, as in the viewer
DISTANCE_M, TILT, FOCAL = 34.0, 0.5, 1.1  # of the camera from the sensor; radians above the horizon; over the width
LOW_M, HIGH_M = -1.9, 2.2  # heights at the two ends of the colours


def main(folder: Path) -> None:
    """Render one turn around both scans."""
    model = lidargrit.load("pretrained")
    street = lidargrit.simulate(5, model.sensor).points_xyz_m.numpy()
    new = lidargrit.unproject(model.sample(seeds=[10])[0]).points_xyz_m.numpy()
    panels = {"simulated street, 64 x 2048": (street, 1), "new, by the model in the package, 64 x 256": (new, 2)}
    frames = []
    for turn in np.linspace(0, 2 * np.pi, COUNT, endpoint=False):
        whole = Image.new("RGB", (2 * WIDE + GAP, TALL), GROUND)
        for index, (title, (points_xyz_m, size)) in enumerate(panels.items()):
            whole.paste(Image.fromarray(picture(points_xyz_m, turn, size)), (index * (WIDE + GAP), 0))
            ImageDraw.Draw(whole).text((index * (WIDE + GAP) + 10, 8), title, fill=(215, 222, 228))
        frames.append(whole)
    path = folder / "turning_view.webp"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0, quality=40, method=2)
    print(f"{COUNT} pictures of {len(street):,} simulated and {len(new):,} generated points")


def picture(points_xyz_m: np.ndarray, turn: float, size: int) -> np.ndarray:
    """Render points coloured by height, the nearest on top, larger where they are nearer.

    Args:
        points_xyz_m: coordinates (n, 3) in metres.
        turn: direction in which the camera stands, in radians.
        size: side of a point in pixels at the distance of the sensor.
    """
    back = np.array([np.cos(turn) * np.cos(TILT), np.sin(turn) * np.cos(TILT), np.sin(TILT)])
    side = np.array([-np.sin(turn), np.cos(turn), 0.0])
    seen = points_xyz_m + np.array([0.0, 0.0, 2.0]) - DISTANCE_M * back
    far_m = seen @ -back
    across = WIDE * (0.5 + FOCAL * (seen @ side) / far_m)
    down = TALL / 2 - WIDE * FOCAL * (seen @ np.cross(back, side)) / far_m
    ahead = far_m > 2.0
    order = np.flatnonzero(ahead)[np.argsort(-far_m[ahead])]  # the nearest last, on top
    height = np.clip((points_xyz_m[:, 2] - LOW_M) / (HIGH_M - LOW_M), 0, 1)
    colours = (255 * colormaps["plasma"](0.12 + 0.88 * height)[:, :3]).astype(np.uint8)
    shown = np.full((TALL, WIDE, 3), GROUND, dtype=np.uint8)
    near = np.clip(np.round(size * DISTANCE_M / np.maximum(far_m, 1.0)), 1, 4).astype(int)
    for right, below in np.ndindex(4, 4):
        drawn = order[(near[order] > right) & (near[order] > below)]
        x, y = across[drawn].astype(int) + right, down[drawn].astype(int) + below
        inside = (x >= 0) & (x < WIDE) & (y >= 0) & (y < TALL)
        shown[y[inside], x[inside]] = colours[drawn[inside]]
    return shown


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))
