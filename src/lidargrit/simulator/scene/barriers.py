"""Long things beside the street: positions → garden walls, fences and guard rails, bent as the street is."""

import numpy as np
from jaxtyping import Float

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.shapes import MeshBuilder, owners, quads
from lidargrit.simulator.scene.street_plan import StreetPlan


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
    home, order = owners(count)
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
    along = np.arange(*plan.stretch.span(100.0), 4.0)
    along = along[plan.in_side_street(along + 2.0, along * 0 + plan.edge(side), 4.0) < 0]
    v = plan.edge(side) + side * rng.uniform(0.5, 1.0)
    steel = rng.uniform(0.25, 0.45)
    rail = plan.blocks(along, along + 4.0, v - 0.04, v + 0.04, 0.45, 0.76)
    post = plan.blocks(along, along + 0.12, v + side * 0.05, v + side * 0.15, -0.2, 0.7)
    builder.add(np.concatenate((rail, post)), materials.METAL, steel, classes.FENCE)
