"""A table of words and numbers as a terminal, Markdown and LaTeX show it."""

from lidargrit.core.table import Table, render

TABLE = Table(
    ("system", "score", "note"), (("a|b", "0.5", ""), ("longer_name", "12.25", "")), "Title", ("said.",), ("noted.",)
)


def test_numbers_stand_right_and_nothing_is_a_dash():
    assert TABLE.as_text().splitlines() == [
        "Title",
        "said.",
        "system       score  note",
        "a|b            0.5     -",
        "longer_name  12.25     -",
        "noted.",
    ]
    assert Table(title="Title", notes=("noted.",)).as_text() == "Title\nnoted."


def test_columns_that_no_row_fills_go_only_if_they_are_named():
    assert TABLE.without_empty("score", "note").head == ("system", "score")
    assert TABLE.without_empty("score") == TABLE


def test_signs_of_markdown_and_latex_are_words():
    markdown, latex = TABLE.as_markdown(), TABLE.as_latex()
    assert r"| a\|b | 0.5 | - |" in markdown.splitlines()
    assert markdown.split("\n\n")[:2] == ["**Title**", "- said."]
    assert r"longer\_name & 12.25 & - \\" in latex.splitlines()
    assert latex.splitlines()[:3] == ["% Title", "% said.", r"\begin{tabular}{lrr}"]


def test_characters_that_steer_a_terminal_are_not_printed():
    assert "\x1b" not in Table(("a\x1b[31m",), (("\x1b[2J",),), "\x1b[0m").as_text()


def test_tables_are_a_line_apart():
    assert render([TABLE, TABLE], "latex") == f"{TABLE.as_latex()}\n\n{TABLE.as_latex()}"
