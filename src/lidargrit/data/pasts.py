"""Range images of drives → the past of each: the scans before it, with their transforms and ages."""

from collections.abc import Sequence

import torch

from lidargrit.core.errors import DataError
from lidargrit.data.images import RangeImages
from lidargrit.data.windows import drives_in
from lidargrit.scans.motion import Motion, transform_between
from lidargrit.scans.past import Past

_NEXT = 0.7  # share of pasts in training that end one scan before the present one
_GAP_AT_MOST = 10  # steps of the others


class Pasts:
    """The pasts of range images of drives.

    Args:
        images: range images whose sources have all fine columns, and times and poses of some.
        count: number of past scans, K.
    """

    def __init__(self, images: RangeImages, count: int) -> None:
        self._fine, self._sensor, self.count = images.with_fine_columns(), images.sensor, count
        self._scans = images.timed_scans()
        self.drives = drives_in(self._scans)
        self._place = {number: (drive, at) for drive in self.drives for at, number in enumerate(drive)}
        if all(len(drive) < 2 for drive in self.drives):
            got = "scans of which none follows another in a drive, with time and pose"
            cure = "simulate some with: lidargrit simulate DRIVES --frames 12 -n 1200"
            raise DataError(got, "drives: scans in a row with times and poses", cure)

    def motion(self, index: int) -> Motion:
        """Return when and where an image was made."""
        return self._scans[index].motion

    def random_gap(self, index: int, rng: torch.Generator) -> int:
        """Return how many steps before an image its past may end in training: mostly 1, else up to 10.

        No gap is drawn that would leave the image without a past where it has one.
        """
        before = self._place[index][1] if index in self._place else 0
        is_next, gap = torch.rand(1, generator=rng), torch.randint(1, _GAP_AT_MOST + 1, (1,), generator=rng)
        return 1 if is_next < _NEXT else max(1, min(int(gap), before))

    def of(
        self, indices: Sequence[int], first_columns: Sequence[int] | None = None, gaps: Sequence[int] | None = None
    ) -> Past:
        """Return the pasts of some images; scans before the first of a drive have no return.

        Args:
            indices: numbers of the images.
            first_columns: index of the fine column at which each image begins; 0 if not given.
            gaps: steps from the latest past scan of each image to the image; 1 if not given.
        """
        pasts = Past.cat(
            [self._past(index, gap) for index, gap in zip(indices, gaps or [1] * len(indices), strict=True)]
        )
        return pasts.turned(torch.tensor(first_columns)) if first_columns and any(first_columns) else pasts

    def _past(self, index: int, gap: int) -> Past:
        past = Past.nothing(self._sensor, 1, self.count)
        drive, at = self._place.get(index, ([], 0))
        now = self._scans[index].motion
        for slot in range(self.count):
            before = at - gap - (self.count - 1 - slot)
            if before < 0:
                continue
            then = self._scans[drive[before]].motion
            if now.pose is not None and then.pose is not None:  # as in all drives
                past.range_m[0, slot] = self._fine.batch([drive[before]]).range_m[0]
                past.transforms[0, slot] = transform_between(then.pose, now.pose)
                past.ages_s[0, slot] = (now.time_s or 0.0) - (then.time_s or 0.0)
        return past
