"""Rows of words and numbers → a table as text, Markdown or LaTeX: what every verb that reports prints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from lidargrit.core.errors import printable

Format = Literal["text", "markdown", "latex"]


@dataclass(frozen=True)
class Table:
    """Rows that may be compared with one another.

    Args:
        head: name of each column, that of the first being the kind of the rows; empty for sentences alone.
        rows: cells of each row, "" where nothing is known.
        title: title of the table; "" for none.
        sentences: sentences above the rows.
        notes: sentences below the rows.
    """

    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    title: str = ""
    sentences: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def without_empty(self, *names: str) -> "Table":
        """Return the table without those of the named columns that no row fills."""
        columns = zip(self.head, *self.rows, strict=True)
        kept = [at for at, (name, *cells) in enumerate(columns) if any(cells) or name not in names]
        head, *rows = (tuple(row[at] for at in kept) for row in (self.head, *self.rows))
        return replace(self, head=head, rows=tuple(rows))

    def as_text(self) -> str:
        """Return lines for a terminal, the first column to the left and all others to the right."""
        grid = self._grid()
        widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
        lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in grid]
        above = [*filter(None, [self.title]), *self.sentences]
        return "\n".join([*map(printable, above), *lines, *map(printable, self.notes)])

    def as_markdown(self) -> str:
        """Return Markdown, with sentences as lists."""
        grid = [[_marked(cell) for cell in row] for row in self._grid()]
        rows = [f"| {' | '.join(row)} |" for row in [*grid[:1], ["---"] * len(self.head), *grid[1:]] if row]
        title = [f"**{_marked(self.title)}**"] * bool(self.title)
        lists = [[f"- {_marked(each)}" for each in lines] for lines in (self.sentences, self.notes)]
        return "\n\n".join("\n".join(part) for part in (title, lists[0], rows, lists[1]) if part)

    def as_latex(self) -> str:
        """Return a ``tabular``, with sentences as comments."""
        said = ((self.title, *self.sentences), self.notes)
        above, notes = ([f"% {' '.join(each.split())}" for each in lines if each] for lines in said)
        if self.head:
            head, *rows = [" & ".join(map(_typeset, row)) + r" \\" for row in self._grid()]
            begin = rf"\begin{{tabular}}{{l{'r' * (len(self.head) - 1)}}}"
            above += [begin, r"\hline", head, r"\hline", *rows, r"\hline", r"\end{tabular}"]
        return "\n".join([*above, *notes])

    def _grid(self) -> list[list[str]]:
        return [[printable(cell or "-") for cell in row] for row in (self.head, *self.rows) if row]


def render(tables: Sequence[Table], form: Format = "text") -> str:
    """Return tables one below the other, with an empty line between them."""
    render_one = {"text": Table.as_text, "markdown": Table.as_markdown, "latex": Table.as_latex}[form]
    return "\n\n".join(map(render_one, tables))


def _marked(text: str) -> str:
    for sign in "\\`*_|<>[]":
        text = text.replace(sign, "\\" + sign)
    return " ".join(text.split())


def _typeset(text: str) -> str:
    signs = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    signs |= {sign: "\\" + sign for sign in "&%$#_{}"}
    return " ".join("".join(signs.get(letter, letter) for letter in text).split())
