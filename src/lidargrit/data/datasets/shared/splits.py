"""Splits as users type them: "train", "00+03", "all[:90%]" → names of sequences and a share of their scans."""

import re
from collections.abc import Collection
from dataclasses import dataclass

from lidargrit.core.errors import DataError

_SHARE = re.compile(r"\[(?:(\d+(?:\.\d+)?)%)?:(?:(\d+(?:\.\d+)?)%)?\]$")


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
    def parse(cls, text: str, known: Collection[str] = ()) -> "Split":
        """Read a split.

        Args:
            text: split as the user typed it.
            known: names of the sequences that there are; they may hold a plus sign and brackets themselves.
        """
        match = None if text in known else _SHARE.search(text)
        selection = text[: match.start()] if match else text
        start, end = (float((match and match[1]) or 0), float((match and match[2]) or 100))
        parts = _named_parts(selection or "all", known)
        unread = next((part[part.index("[") :] for part in parts if "[" in part and part not in known), "")
        if unread or not 0 <= start < end <= 100:
            raise DataError(
                f"the share {unread or (match and match[0])!r} in the split {text!r}",
                "a block of the scans such as [:90%], [90%:] or [80%:90%]",
                f"type {(selection.partition('[')[0] or 'all') + '[:90%]'!r} for the first nine tenths",
            )
        return cls(text, parts, start, end)

    def block(self, count: int) -> slice:
        """Return which of ``count`` scans in order are meant; [:p%] and [p%:] share none and leave none out."""
        return slice(round(count * self.start_percent / 100), round(count * self.end_percent / 100))


def _named_parts(selection: str, known: Collection[str]) -> tuple[str, ...]:
    """Divide at plus signs, but not within the name of a sequence: the longest name that there is counts."""
    rest, parts = selection.split("+"), list[str]()
    while rest:
        names = ("+".join(rest[:count]) for count in range(len(rest), 1, -1))
        parts.append(next((name for name in names if name in known), rest[0]))
        rest = rest[parts[-1].count("+") + 1 :]
    return tuple(parts)
