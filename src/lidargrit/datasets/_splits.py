"""Splits as users type them: "train", "00+03", "all[:90%]" → names of sequences and a share of their scans."""

from __future__ import annotations

import re
from dataclasses import dataclass

from lidargrit.errors import DataError

_SHARE = re.compile(r"\[(?:(\d+(?:\.\d+)?)%)?:(?:(\d+(?:\.\d+)?)%)?\]")


@dataclass(frozen=True)
class Split:
    """A parsed split such as ``train+val[:90%]``: names of parts, and a share of their scans.

    Args:
        text: split as the user typed it.
        parts: "all", named splits and sequences, joined by "+" in the text.
        start_percent: begin of the block of scans, in percent.
        end_percent: end of the block of scans, in percent.
    """

    text: str
    parts: tuple[str, ...]
    start_percent: float
    end_percent: float

    @classmethod
    def parse(cls, text: str) -> Split:
        """Read a split.

        Raises:
            DataError: brackets that hold no share.
        """
        selection, bracket, rest = text.partition("[")
        match = _SHARE.fullmatch(bracket + rest) if bracket else None
        start, end = (float((match and match[1]) or 0), float((match and match[2]) or 100))
        if (bracket and match is None) or not 0 <= start < end <= 100:
            raise DataError(
                f"the share {bracket + rest!r} in the split {text!r}",
                "a block of the scans such as [:90%], [90%:] or [80%:90%]",
                f"type {(selection or 'all') + '[:90%]'!r} for the first nine tenths",
            )
        return cls(text, tuple((selection or "all").split("+")), start, end)

    def block(self, count: int) -> slice:
        """Return which of ``count`` scans in order are meant; [:p%] and [p%:] share none and leave none out."""
        return slice(round(count * self.start_percent / 100), round(count * self.end_percent / 100))
