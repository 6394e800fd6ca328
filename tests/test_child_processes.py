"""Every Python process that the program starts ignores Python files in the current folder, whoever put them there."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.core.processes import process_pool
from lidargrit.viewer.serve.jobs import JobQueue
from test_generator_contract import made


@pytest.fixture
def poisoned(tmp_path, monkeypatch) -> Path:
    """Make a folder of downloads the current one; its Python files leave a trace if anything imports them."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    for name in ("json", "random", "signal", "queue", "multiprocessing", "lidargrit", "numpy"):
        (folder / f"{name}.py").write_text(f"open({str(folder / f'{name}.ran')!r}, 'w').close()\n")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return folder


def traces(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.ran"))


def test_serve_runs_nothing_from_the_current_folder(poisoned, tmp_path):
    made("marginal")[0].save(tmp_path / "run")
    (tmp_path / "results").mkdir()
    with JobQueue([tmp_path / "run"], tmp_path / "results") as queue:
        assert len(queue.models) == 1
    assert traces(poisoned) == []


POOL = """
import os, signal, time
from lidargrit.core.processes import process_pool
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs do not hear Ctrl-C
    with process_pool(2) as pool:
        print(*{pool.submit(os.getpid).result() for _ in range(4)}, flush=True)
        pool.submit(time.sleep, 60)
        time.sleep(60)
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -9), (signal.SIGTERM, -15), (signal.SIGINT, 1)])
def test_processes_of_a_pool_end_with_the_one_that_began_them(tmp_path, number, code):
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    parent = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert parent.stdout is not None
    children = [int(word) for word in parent.stdout.readline().split()]
    assert children
    (os.killpg if number == signal.SIGINT else os.kill)(parent.pid, number)
    stderr = parent.communicate(timeout=20)[1]
    assert parent.returncode in (code, -number)
    deadline = time.monotonic() + 10
    while (living := [pid for pid in children if Path(f"/proc/{pid}").exists()]) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not living
    assert stderr.count("Traceback") == (number == signal.SIGINT), (
        stderr
    )  # that of the script itself, which catches nothing


def test_a_pool_runs_nothing_from_the_current_folder_and_a_death_in_it_is_one_line(poisoned):
    with process_pool(1) as pool:
        assert pool.submit(os.getpid).result() != os.getpid()
    with pytest.raises(DataError, match="got a process that died"), process_pool(1) as pool:
        pool.submit(os._exit, 3).result()
    assert traces(poisoned) == []
    for count in (0, 10**7):
        with pytest.raises(ConfigError, match=f"got {count} processes; wanted 1 to 1,024"), process_pool(count):
            pass
