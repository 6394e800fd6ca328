"""Labels of points → a word where they are no numbers of SemanticKITTI."""

from jaxtyping import Int
from torch import Tensor

from lidargrit.scans.classes import listed, unknown_numbers
from lidargrit.scans.types import CLASS_BITS


def notes_on_labels(label: Int[Tensor, "n"] | None) -> tuple[str, ...]:
    """Return a note if some classes are none of SemanticKITTI's, so that the others are most likely none either."""
    if label is None or not (unknown := unknown_numbers(label)):
        return ()
    low, high = (int(number) for number in (label.long() & CLASS_BITS).aminmax())
    what = f"labels from {low} to {high} are not SemanticKITTI's, which has no {listed(unknown)}"
    return (f"{what}; map them to its numbers (learning_map_inv, if its learning_map made them)",)
