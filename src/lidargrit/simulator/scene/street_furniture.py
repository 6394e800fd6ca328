"""Street furniture: positions → walls, fences, guard rails, poles, lamps, signs, bins and cabinets."""

import numpy as np
from jaxtyping import Float, Num

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.shapes import MeshBuilder, boxes, fans, owners, quads, rows_of, tubes
from lidargrit.simulator.scene.street_plan import Poses, StreetPlan


def add_walls(
    builder: MeshBuilder,
    rng: np.random.Generator,
    plan: StreetPlan,
    u_m: Float[np.ndarray, "n 2"],
    v_m: Float[np.ndarray, "n 2"],
    height_m: Float[np.ndarray, " n"],
    rise_m: float = 0.0,
) -> None:
    """Add garden walls that fill boxes of the street."""
    solid = plan.blocks(u_m.min(axis=1), u_m.max(axis=1), v_m.min(axis=1), v_m.max(axis=1), -0.3, rise_m + height_m)
    stone = rng.choice([materials.CONCRETE, materials.BRICK, materials.PLASTER], len(u_m))
    builder.add(solid, stone[:, None], rng.uniform(0.2, 0.5, (len(u_m), 1)), classes.FENCE)


def add_fences(
    builder: MeshBuilder,
    rng: np.random.Generator,
    plan: StreetPlan,
    u_m: Float[np.ndarray, "n 2"],
    v_m: Float[np.ndarray, "n 2"],
    height_m: Float[np.ndarray, " n"],
    rise_m: float = 0.0,
) -> None:
    """Add picket fences, each from a first to a second point; beams pass between the pickets."""
    length = np.hypot(u_m[:, 1] - u_m[:, 0], v_m[:, 1] - v_m[:, 0])
    pitch = rng.uniform(0.12, 0.3, len(length))
    count = np.clip(length / pitch, 2, 90).astype(int)
    home = owners(count)
    order = np.arange(len(home)) - np.repeat(np.cumsum(count) - count, count)
    half = (0.5 * rng.uniform(0.25, 0.75, len(length)) * length / count)[home]
    at = (order + 0.5) * (length / count)[home]
    share = np.stack((at - half, at + half), axis=1) / length[home][:, None]
    posts = _upright(plan, u_m[home], v_m[home], share, rise_m, rise_m + height_m[home])
    ends = np.broadcast_to(np.array([0.0, 1.0]), (len(length), 2))
    rails = [
        _upright(plan, u_m, v_m, ends, rise_m + height_m * at - 0.05, rise_m + height_m * at + 0.05)
        for at in (0.2, 0.85)
    ]
    bright = rng.uniform(0.2, 0.5, len(length))
    made = rng.choice([materials.METAL, materials.BARK], len(length))
    builder.add(posts, made[home][:, None], bright[home][:, None], classes.FENCE)
    for rail in rails:
        builder.add(rail, made[:, None], bright[:, None], classes.FENCE)


def _upright(
    plan: StreetPlan,
    u_m: np.ndarray,
    v_m: np.ndarray,
    share: np.ndarray,
    bottom_m: float | np.ndarray,
    top_m: float | np.ndarray,
) -> np.ndarray:
    u = u_m[:, :1] + (u_m[:, 1:] - u_m[:, :1]) * share
    v = v_m[:, :1] + (v_m[:, 1:] - v_m[:, :1]) * share
    foot = plan.ground_points(u, v)
    corners = foot[:, [0, 1, 1, 0]]
    corners[..., 2] += np.stack(np.broadcast_arrays(bottom_m, bottom_m, top_m, top_m, u[:, 0])[:4], axis=1)
    return quads(corners)


def add_guard_rails(builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, side: int) -> None:
    """Add a rail on posts along one side of our road."""
    along = np.arange(-100.0, 100.0, 4.0)
    along = along[plan.in_side_street(along + 2.0, along * 0 + plan.edge(side), 4.0) < 0]
    v = plan.edge(side) + side * rng.uniform(0.5, 1.0)
    steel = rng.uniform(0.25, 0.45)
    rail = plan.blocks(along, along + 4.0, v - 0.04, v + 0.04, 0.45, 0.76)
    post = plan.blocks(along, along + 0.12, v + side * 0.05, v + side * 0.15, -0.2, 0.7)
    builder.add(np.concatenate((rail, post)), materials.METAL, steel, classes.FENCE)


def add_lamps(builder: MeshBuilder, rng: np.random.Generator, poses: Poses) -> None:
    """Add lamp posts and plain masts; arms reach along +x of their own frame."""
    count = len(poses.yaw_rad)
    if not count:
        return
    tall, thick = rng.uniform(4.0, 9.0, count), rng.uniform(0.05, 0.11, count)
    grey = rng.uniform(0.15, 0.4, (count, 1))
    foot, head = rows_of(0.0, 0.0, -0.3 * np.ones(count)), rows_of(0.0, 0.0, tall)
    reach = rng.uniform(0.4, 2.0, count)
    mast = tubes(foot, head, thick, thick * 0.6, sides=8)
    arm = tubes(head, rows_of(reach, 0.0, tall + 0.2), 0.04, 0.04, sides=4)
    lamp = boxes(rows_of(reach - 0.1, -0.15, tall + 0.1), rows_of(reach + 0.5, 0.15, tall + 0.25))
    builder.add(poses.to_world(np.concatenate((mast, arm, lamp), axis=1)), materials.METAL, grey, classes.POLE)


def add_signs(builder: MeshBuilder, rng: np.random.Generator, poses: Poses) -> None:
    """Add traffic signs that face along -x of their own frame, some with two plates."""
    count = len(poses.yaw_rad)
    if not count:
        return
    tall = rng.uniform(2.3, 3.1, count)
    pole = tubes(rows_of(0.0, 0.0, -0.3 * np.ones(count)), rows_of(0.0, 0.0, tall), 0.035, 0.035, sides=6)
    builder.add(poses.to_world(pole), materials.METAL, rng.uniform(0.2, 0.4, (count, 1)), classes.POLE)
    kind, radius = rng.integers(0, 4, count), rng.uniform(0.28, 0.42, count)
    corners = np.array([3, 4, 8, 8])[kind]  # a triangle, a square, an octagon, and a round one, nearly
    step = (np.arange(8) * corners[:, None] // 8) * (2 * np.pi / corners)[:, None]
    turn = np.where(kind[:, None] == 0, np.pi / 2, np.pi / corners[:, None]) + step
    rim = np.stack((0 * turn, radius[:, None] * np.cos(turn), radius[:, None] * np.sin(turn)), axis=-1)
    rim += rows_of(0.0, 0.0, tall - 0.4)[:, None]
    for x, material, bright in ((-0.05, materials.FOIL, 0.5), (-0.04, materials.METAL, 0.3)):
        face = poses.to_world(fans(rim + np.array([x, 0, 0])))
        # Triangles and squares repeat corners of the eight: what has no area is left out.
        true = np.linalg.norm(np.cross(face[..., 1, :] - face[..., 0, :], face[..., 2, :] - face[..., 0, :]), axis=-1)
        builder.add(face[true > 1e-4], material, bright, classes.TRAFFIC_SIGN)


def add_bins(builder: MeshBuilder, rng: np.random.Generator, poses: Poses) -> None:
    """Add bins, cabinets and such blocks, 0.4 to 1.6 m."""
    count = len(poses.yaw_rad)
    if not count:
        return
    half = rng.uniform(0.2, 0.45, (count, 2)) * np.array([1.0, 0.7])
    low = np.column_stack((-half, np.full(count, -0.2)))
    high = np.column_stack((half, rng.uniform(0.6, 1.3, count)))
    builder.add(
        poses.to_world(boxes(low, high)), materials.PAINT, rng.uniform(0.05, 0.5, (count, 1)), classes.OTHER_OBJECT
    )


def add_bollards(
    builder: MeshBuilder,
    rng: np.random.Generator,
    plan: StreetPlan,
    u_m: Num[np.ndarray, " n"],
    v_m: Num[np.ndarray, " n"],
) -> None:
    """Add a row of low posts."""
    if not len(u_m):
        return
    foot = plan.ground_points(u_m, v_m)
    posts = tubes(foot, foot + np.array([0, 0, rng.uniform(0.8, 1.2)]), 0.06, 0.06, sides=6)
    builder.add(posts, materials.METAL, rng.uniform(0.15, 0.5), classes.POLE)
