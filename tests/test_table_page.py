"""The page of a comparison: what it says of real against real, how it counts, and which folders it does not name."""

from lidargrit.viewer.table_page import table_page
from test_compare import cell_of


def test_a_reader_learns_what_real_against_real_is_and_of_how_many_scans():
    page = table_page([cell_of("a"), cell_of("b")], 0.0)
    assert "real against real <small>(n = 9)</small>" in page
    assert page.count("The halves are smaller than the sets") == 1
    assert "a good score may still lie below it" in page


def test_systems_are_counted_in_words():
    assert "<h1>1 system</h1>" in table_page([cell_of("a")], 0.0)
    assert "<h1>2 systems</h1>" in table_page([cell_of("a"), cell_of("b")], 0.0)


def test_the_page_names_no_folder_of_the_machine():
    cell = cell_of("a", source="kitti_360:/home/jane doe/secret (old)/scans:val")
    cell["scores"]["warnings"] = ["/home/jane doe/secret (old)/scans: few scans"]
    page = table_page([cell], 0.0)
    assert "of kitti_360:…/scans:val" in page
    assert "…/scans: few scans" in page
    assert "jane" not in page
    assert "secret" not in page
