"""What stands and moves in one stretch of a street: random numbers and a plan → triangles and kept objects."""

import copy
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lidargrit.simulator.mesh import Mesh, Objects
from lidargrit.simulator.scene.buildings import add_houses
from lidargrit.simulator.scene.clutter import clutter
from lidargrit.simulator.scene.greenery import greenery
from lidargrit.simulator.scene.layout import add_gardens, things, traffic
from lidargrit.simulator.scene.objects import ObjectBatch
from lidargrit.simulator.scene.roads import GroundLook, PaintLook, add_bridge, add_ground, add_markings
from lidargrit.simulator.scene.settlement import Settlement, lay_out_houses
from lidargrit.simulator.scene.shapes import MeshBuilder
from lidargrit.simulator.scene.street_plan import StreetPlan
from lidargrit.simulator.scene.stretches import Stretch


@dataclass(frozen=True, eq=False)
class Parts:
    """All of one stretch.

    Args:
        standing: triangles that are of this street alone: its ground, its houses, its walls and fences.
        still: kept objects that never move.
        moving: kept objects that do.
        town: places of houses.
        ground: look of the ground, which further stretches share.
        paint: look of the markings, which further stretches share.
    """

    standing: Mesh
    still: Objects
    moving: tuple[ObjectBatch, ...]
    town: Settlement
    ground: GroundLook
    paint: PaintLook


def lay_out_first(rng: np.random.Generator, plan: StreetPlan, to_the_end: bool = False) -> Parts:
    """Lay out the stretch in which a drive begins.

    Args:
        to_the_end: whether houses have their details all along our road, and not only where our car is soon.
    """
    builder = MeshBuilder()
    ground = add_ground(builder, rng, plan)
    paint = add_markings(builder, rng, plan)
    add_bridge(builder, rng, plan)
    town = lay_out_houses(rng, plan)
    if to_the_end:
        add_houses(builder, copy.deepcopy(rng), replace(plan, stretch=Stretch.REST), town.houses)
    # What comes later in the random stream stays as it is without details.
    add_houses(MeshBuilder() if to_the_end else builder, rng, plan, town.houses)
    return _furnished(builder, rng, plan, town, ground, paint)


def lay_out_rest(rng: np.random.Generator, plan: StreetPlan, first: Parts) -> Parts:
    """Lay out the first stretch and what it leaves bare before its far end, where our car comes later."""
    builder, rest = MeshBuilder(), replace(plan, stretch=Stretch.REST)
    add_markings(builder, rng, rest, first.paint)
    town = replace(first.town, parks_m=first.town.parks_m[:0])  # which are full of trees
    taken = max((int(some.instance.max(initial=0)) for some in (first.still, *first.moving)), default=0)
    more = _furnished(builder, rng, rest, town, first.ground, first.paint, first_instance=taken + 1)
    return replace(
        first,
        standing=Mesh.join([first.standing, more.standing]),
        still=Objects.join([first.still, more.still]),
        moving=(*first.moving, *more.moving),
    )


def lay_out_further(
    rng: np.random.Generator,
    plan: StreetPlan,
    first: Parts,
    taken_m: Float[np.ndarray, "n 4"] | None,
    oncoming_m_s: float,
) -> Parts:
    """Lay out a further stretch, which looks like the first one.

    Args:
        taken_m: bounds of houses of the stretch before that may lie in this one, in this one's coordinates.
        oncoming_m_s: speed of those who drive towards us.
    """
    builder = MeshBuilder()
    add_ground(builder, rng, plan, first.ground)
    add_markings(builder, rng, plan, first.paint)
    add_bridge(builder, rng, plan)
    town = lay_out_houses(rng, plan, taken_m)
    add_houses(builder, rng, plan, town.houses)
    return _furnished(builder, rng, plan, town, first.ground, first.paint, oncoming_m_s)


def _furnished(
    builder: MeshBuilder,
    rng: np.random.Generator,
    plan: StreetPlan,
    town: Settlement,
    ground: GroundLook,
    paint: PaintLook,
    oncoming_m_s: float = 0.0,
    first_instance: int = 1,
) -> Parts:
    batches = [
        *add_gardens(builder, rng, plan, town),
        *greenery(rng, plan, town),
        things(rng, plan),
        clutter(rng, plan),
    ]
    still, moving = [batch.at(plan) for batch in batches], []
    for batch in traffic(rng, plan, town, oncoming_m_s, first_instance):
        stands, goes = batch.split()
        still.append(stands.at(plan))
        if len(goes.placements):
            moving.append(goes)
    return Parts(builder.build(), Objects.join(still), tuple(moving), town, ground, paint)
