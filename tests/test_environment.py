"""Ranks and folders that the environment names."""

import os

import pytest

from lidargrit.cli import main
from lidargrit.core.environment import cache_folder, folder_in
from lidargrit.core.errors import ConfigError
from lidargrit.core.processes import rank_and_world_size


@pytest.fixture(autouse=True)
def environment(monkeypatch, tmp_path):
    for name in ("LIDARGRIT_CACHE", "XDG_CACHE_HOME", "RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("variables", "wanted"),
    [
        ({}, "home/.cache/lidargrit"),
        ({"LIDARGRIT_CACHE": ""}, "home/.cache/lidargrit"),
        ({"LIDARGRIT_CACHE": "~/x"}, "home/x"),
        ({"LIDARGRIT_CACHE": "x"}, "x"),
        ({"XDG_CACHE_HOME": ""}, "home/.cache/lidargrit"),
        ({"XDG_CACHE_HOME": "~/y"}, "home/y/lidargrit"),
        ({"XDG_CACHE_HOME": "y", "LIDARGRIT_CACHE": "x"}, "x"),
    ],
)
def test_the_cache_is_where_the_variables_say(monkeypatch, tmp_path, variables, wanted):
    for name, value in variables.items():
        monkeypatch.setenv(name, value.replace("x", f"x_{tmp_path.name}"))  # a relative folder is resolved once
    assert cache_folder() == tmp_path / wanted.replace("x", f"x_{tmp_path.name}")


def test_a_relative_folder_stays_where_it_was_when_the_current_one_changes(monkeypatch, tmp_path):
    monkeypatch.setenv("A_FOLDER", f"relative_{tmp_path.name}")
    first = folder_in("A_FOLDER")
    (tmp_path / "below").mkdir()
    os.chdir(tmp_path / "below")
    assert folder_in("A_FOLDER") == first == tmp_path / f"relative_{tmp_path.name}"


def test_a_folder_of_nobody_is_refused_in_one_line(monkeypatch):
    monkeypatch.setenv("A_FOLDER", "~no_such_user/x")
    with pytest.raises(ConfigError, match=r"got A_FOLDER=~no_such_user/x; wanted a folder"):
        folder_in("A_FOLDER")
    monkeypatch.delenv("A_FOLDER")
    assert folder_in("A_FOLDER") is None


def test_commands_keep_scans_in_the_home_of_the_user_and_find_them_there(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", "~/x")
    words = ["data.train=simulated:1:train", "data.val=simulated:1:val", "data.workers=1", "data.columns=64"]
    assert main(["train", "marginal", "run", "--set", *words]) == 0
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "home" / "x").glob("*/made/*.json")}
    assert len(kept) == 2
    assert main(["train", "memorised", "again", "--set", *words]) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "home" / "x").glob("*/made/*.json")} == kept
    assert main(["doctor"]) == 0
    assert str(tmp_path / "home" / "x") in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"home", "run", "again"}, "no folder called ~"


def test_a_rank_is_what_is_given_or_what_a_launcher_says(monkeypatch):
    assert rank_and_world_size() == (0, 1)
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert rank_and_world_size() == (2, 4)
    assert rank_and_world_size(3) == (3, 4)
    with pytest.raises(ConfigError, match="rank 4 of 4"):
        rank_and_world_size(4)
    monkeypatch.setenv("RANK", "second")
    with pytest.raises(ConfigError, match=r"RANK='second'; wanted a whole number from 0"):
        rank_and_world_size()
