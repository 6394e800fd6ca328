"""The page on other programs: its commands, and those of its examples whose program is installed."""

import importlib.util
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from lidargrit.cli import main

PAGE = (Path(__file__).parents[1] / "docs/how-to/use-it-with.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Run the page's commands on two scans of 32 rings around a room, with rings."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "drive").mkdir()
    azimuth, ring = (grid.ravel() for grid in np.meshgrid(np.linspace(-3, 3, 200), np.arange(32)))
    elevation, rng = np.radians(10 - 40 * ring / 31), np.random.default_rng(0)
    for number in range(2):
        range_m = 10 + 2 * np.sin(3 * azimuth) + 0.02 * rng.normal(size=azimuth.shape)
        columns = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)
        points = (range_m * columns).T.astype(np.float32)
        np.savez(folder / f"drive/{number:06d}.npz", points=points, intensity=rng.random(len(points)), ring=ring)
    (script,) = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (*script.splitlines(), "lidargrit export drive nuscenes --format nuscenes_bin"):
            assert main(shlex.split(line)[1:]) == 0
    return folder


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: re.findall(r"^(?:from|import) (\w+)", text, re.M)[-1])
def test_examples_run_where_their_program_is_installed(example, folder, monkeypatch, capsys):
    for name in re.findall(r"^(?:from|import) (\w+)", example, re.MULTILINE):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    monkeypatch.chdir(folder)
    exec(compile(example, "use-it-with.md", "exec"), {})
    assert capsys.readouterr().out.strip() or "print" not in example


def test_what_the_programs_are_given_has_their_form(folder):
    assert np.load(folder / "clouds/000000.npy")[:, :4].shape == (6400, 4)
    assert (folder / "bins/000000.bin").stat().st_size == 6400 * 4 * 4
    assert (folder / "recordings/scans.mcap").read_bytes().startswith(b"\x89MCAP")
