"""Files that appear whole or not at all: killed writers, several writers, folders that a command holds."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import safetensors
import torch

from lidargrit.core.errors import CheckpointError, OutputError, ScanError
from lidargrit.core.files import (
    atomic_path,
    claim_folder,
    is_taken,
    read_tensors,
    refuse_to_overwrite,
    remove_partials,
    write_tensors,
    write_text,
)
from lidargrit.data.sources.sample_formats import read_tensor

WRITE_AND_WAIT = """
import sys, time
from pathlib import Path
from lidargrit.core.files import atomic_path, claim_folder
with atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"half")
    print("written", flush=True)
    time.sleep(600)
"""
CLAIM_AND_WAIT = """
import sys, time
from pathlib import Path
from lidargrit.core.files import claim_folder
with claim_folder(Path(sys.argv[1]), shared=len(sys.argv) > 2):
    print("claimed", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def started():
    """Return a function that runs a script until it has printed a line; kills it at the end."""
    processes = []

    def start(script: str, *words: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", script, *map(str, words)]
        processes.append(process := subprocess.Popen(command, stdout=subprocess.PIPE))
        assert process.stdout is not None
        assert process.stdout.readline()
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    assert process.wait() == -signal.SIGKILL


def test_a_killed_write_leaves_nothing_that_a_reader_takes_for_a_file(tmp_path, started):
    kill(started(WRITE_AND_WAIT, tmp_path / "000002.bin"))
    assert not [path for path in tmp_path.iterdir() if path.is_file()]
    (left,) = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert left.suffix == ".partial"
    assert left.parent.name.startswith(".")
    assert not is_taken(tmp_path)


def test_the_next_write_into_the_folder_removes_what_a_killed_one_left(tmp_path, started):
    kill(started(WRITE_AND_WAIT, tmp_path / "000002.bin"))
    write_text(tmp_path / "another.txt", "whole")
    assert everything_in(tmp_path) == ["another.txt"]


def test_what_a_living_process_is_writing_stays(tmp_path, started):
    process = started(WRITE_AND_WAIT, tmp_path / "000002.bin")
    write_text(tmp_path / "another.txt", "whole")
    remove_partials(tmp_path)
    assert [path.read_bytes() for path in tmp_path.rglob("*.partial")] == [b"half"]
    kill(process)
    remove_partials(tmp_path)
    assert everything_in(tmp_path) == ["another.txt"]


def test_the_end_of_a_command_leaves_no_partial_file_anywhere_in_its_folder(tmp_path, started):
    for name in ("sequences/00/velodyne/000000.bin", "sequences/01/velodyne/000000.bin"):
        kill(started(WRITE_AND_WAIT, tmp_path / "out" / name))
    with claim_folder(tmp_path / "out"):
        write_text(tmp_path / "out" / "sequences" / "00" / "velodyne" / "000000.bin", "whole")
    files = [path.name for path in (tmp_path / "out").rglob("*") if path.is_file() or path.name.startswith(".")]
    assert files == ["000000.bin"]


def test_a_folder_is_claimed_by_one_command_that_says_who_it_is(tmp_path, started):
    holder = started(CLAIM_AND_WAIT, tmp_path / "out")
    with (
        pytest.raises(OutputError, match=f"which process {holder.pid} on .* is writing"),
        claim_folder(tmp_path / "out"),
    ):
        pytest.fail("two commands hold the folder")
    kill(holder)
    with claim_folder(tmp_path / "out"):
        write_text(tmp_path / "out" / "file.txt", "whole")
    assert everything_in(tmp_path / "out") == ["file.txt"]


def test_commands_that_share_a_folder_keep_out_only_those_that_do_not(tmp_path, started):
    started(CLAIM_AND_WAIT, tmp_path / "out", "shared")
    with claim_folder(tmp_path / "out", shared=True):
        write_text(tmp_path / "out" / "file.txt", "whole")
    with pytest.raises(OutputError, match="which another command is writing"), claim_folder(tmp_path / "out"):
        pytest.fail("it is held by another")


def test_a_folder_that_its_last_holder_removes_meanwhile_is_made_again(tmp_path, monkeypatch):
    folder, is_dir, removed = tmp_path / "out", Path.is_dir, []

    def removed_once(path: Path) -> bool:
        if path == folder and not removed:
            removed.append(path.rmdir())
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", removed_once)
    with claim_folder(folder):
        write_text(folder / "file.txt", "whole")
    assert len(removed) == 1
    assert everything_in(folder) == ["file.txt"]


def test_a_claim_that_comes_to_nothing_leaves_no_folder(tmp_path):
    with pytest.raises(KeyError), claim_folder(tmp_path / "new" / "out"):
        raise KeyError
    assert everything_in(tmp_path) == ["new"]


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("is_made_anew", [False, True])
def test_a_claimed_folder_that_is_removed_meanwhile_is_an_error(tmp_path, shared, is_made_anew):
    def work() -> None:
        with claim_folder(tmp_path / "out", shared):
            write_text(tmp_path / "out" / "a", "text")
            shutil.rmtree(tmp_path / "out")
            if is_made_anew:
                write_text(tmp_path / "out" / "b", "text")

    with pytest.raises(OutputError, match="out, from which files were removed meanwhile"):
        work()
    assert everything_in(tmp_path) == (["out", "out/b"] if is_made_anew else [])


def test_many_threads_write_into_one_folder_and_leave_their_files_alone(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda index: write_text(tmp_path / f"{index}.txt", f"{index}"), range(400)))
    assert sorted(os.listdir(tmp_path)) == sorted(f"{index}.txt" for index in range(400))
    assert all((tmp_path / f"{index}.txt").read_text() == f"{index}" for index in range(400))


def test_tensors_stay_locked_until_they_have_their_name(tmp_path, monkeypatch):
    sync = os.fsync

    def while_another_command_ends(file: int) -> None:
        sync(file)
        remove_partials(tmp_path)

    monkeypatch.setattr(os, "fsync", while_another_command_ends)
    write_tensors(tmp_path / "a.safetensors", {"x": torch.ones(3)}, {"of": 1})
    tensors, about = read_tensors(tmp_path / "a.safetensors")
    assert torch.equal(tensors["x"], torch.ones(3))
    assert about == {"of": 1}


def test_a_lock_made_anew_while_another_is_swept_stays(tmp_path, monkeypatch):
    hidden = tmp_path / f".lidargrit-partial-{os.getuid()}"
    hidden.mkdir()
    (hidden / "lock").touch()
    lock = fcntl.flock

    def after_another_sweep(file: int, kind: int) -> None:
        (hidden / "lock").unlink()
        (hidden / "lock").write_text("process 7")
        lock(file, kind)

    monkeypatch.setattr(fcntl, "flock", after_another_sweep)
    remove_partials(tmp_path)
    assert (hidden / "lock").read_text() == "process 7"


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyError), atomic_path(tmp_path / "a.txt") as temporary:  # noqa: PT012
        temporary.write_text("new")
        raise KeyError
    assert everything_in(tmp_path) == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_no_folder_that_was_made_for_it(tmp_path, error):
    with pytest.raises((OutputError, KeyboardInterrupt)), atomic_path(tmp_path / "new" / "a.bin"):
        raise error
    assert not (tmp_path / "new").exists()


def test_a_folder_that_is_removed_meanwhile_ends_the_write_in_one_line(tmp_path):
    with pytest.raises(OutputError, match="while writing"), atomic_path(tmp_path / "out" / "a.txt") as temporary:  # noqa: PT012
        temporary.write_text("new")
        (tmp_path / "out").rename(tmp_path / "elsewhere")


def test_a_name_as_long_as_the_disk_allows_is_written(tmp_path):
    name = "x" * 251 + ".txt"
    write_text(tmp_path / name, "whole")
    assert os.listdir(tmp_path) == [name]
    with pytest.raises(OutputError, match="too long"):
        write_text(tmp_path / f"x{name}", "whole")


KILLED_AND_FINISHED = """
import os, signal, sys, time
from pathlib import Path
from lidargrit.data.export import export_scans
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.scans.sensors import load_sensor
from lidargrit.data.drives import DriveConfig, write_drives

COMMANDS = {
    "simulate": lambda out: write_drives(out, 4, DriveConfig(load_sensor("vlp16"))),
    "export": lambda out: export_scans("simulated:4@vlp16", out, "pcd"),
    "prepare": lambda out: prepare("simulated:4@vlp16", DataConfig(sensor="vlp16", workers=1), out),
}

def begun(command, out):
    child = os.fork()
    if child:
        return child
    try:
        command(out)
        os._exit(0)
    finally:
        os._exit(1)

for name, command in COMMANDS.items():
    out = Path(sys.argv[1]) / name
    for delay_s in (0.0, 0.15, 0.3):
        child, until = begun(command, out), time.monotonic() + 60
        while not out.exists() and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(delay_s)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    if os.waitpid(begun(command, out), 0)[1]:
        sys.exit(f"{name} did not end well")
"""


def test_the_command_that_finishes_a_killed_one_leaves_whole_files_alone(tmp_path):
    """All commands are forks of one process, so that modules are imported once."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AND_FINISHED, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["export", "prepare", "simulate"]
    assert not [name for name in everything_in(tmp_path) if name.startswith(".") or "/." in name]


def test_a_folder_is_never_taken_for_a_file_to_replace(tmp_path):
    with pytest.raises(OutputError, match="which is a folder; wanted a file"):
        refuse_to_overwrite(tmp_path, overwrite=True)


def test_tensors_are_read_where_no_interrupt_is_taken_for_damage(tmp_path, monkeypatch):
    write_tensors(tmp_path / "a.safetensors", {"a": torch.zeros(2)})
    opened, threads = safetensors.safe_open, []

    def safe_open(*given, **named):
        threads.append(threading.current_thread())
        return opened(*given, **named)

    monkeypatch.setattr(safetensors, "safe_open", safe_open)
    read_tensors(tmp_path / "a.safetensors")
    assert threads
    assert threading.main_thread() not in threads


def test_tensors_that_may_not_be_read_are_not_called_missing(tmp_path, monkeypatch):
    write_tensors(tmp_path / "a.safetensors", {"a": torch.zeros(2)})

    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(CheckpointError, match=r"cannot be read \(Permission denied\); .*; change its permissions"):
        read_tensors(tmp_path / "a.safetensors")


@pytest.mark.parametrize(("read", "error"), [(read_tensors, CheckpointError), (read_tensor, ScanError)])
def test_a_pipe_is_refused_and_does_not_hang(tmp_path, read, error):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(error, match="not a file"):
        read(tmp_path / "pipe")
