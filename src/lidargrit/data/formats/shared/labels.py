"""Labels of points → a word where they are no numbers of SemanticKITTI."""

from jaxtyping import Int
from torch import Tensor

from lidargrit.scans.types import CLASS_BITS

SEMANTIC_KITTI = frozenset(
    (0, 1, 10, 11, 13, 15, 16, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 52, 60, 70, 71, 72, 80, 81, 99)
) | frozenset(range(252, 260))
"""Numbers of its classes: Behley et al., ICCV 2019, and the configuration published with it."""
_NAMED_AT_MOST = 8


def notes_on_labels(label: Int[Tensor, "n"] | None) -> tuple[str, ...]:
    """Return a note if some classes are none of SemanticKITTI's, so that the others are most likely none either."""
    if label is None:
        return ()
    there = sorted(int(number) for number in (label & CLASS_BITS).unique())
    if not (unknown := [number for number in there if number not in SEMANTIC_KITTI]):
        return ()
    shown = ", ".join(map(str, unknown[:_NAMED_AT_MOST])) + (", ..." if len(unknown) > _NAMED_AT_MOST else "")
    what = f"labels from {there[0]} to {there[-1]} are not SemanticKITTI's, which has no {shown}"
    return (f"{what}; map them to its numbers (learning_map_inv, if its learning_map made them)",)
