"""The installation: which build of torch pip is asked for, with and without a GPU and PyTorch's index."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "install.sh"
CPU = "--extra-index-url https://download.pytorch.org/whl/cpu"


@pytest.mark.skipif(shutil.which("sh") is None or os.uname().sysname != "Linux", reason="for Linux")
@pytest.mark.parametrize(
    ("has_gpu", "has_torch", "answers", "cpu_build", "said"),
    [
        (False, False, True, True, "build for CPUs"),
        (False, False, False, False, "does not answer"),
        (True, False, True, False, ""),
        (False, True, True, False, ""),
    ],
)
def test_machines_without_a_gpu_get_the_small_build(tmp_path, has_gpu, has_torch, answers, cpu_build, said):
    commands = tmp_path / "commands"
    commands.mkdir()
    (commands / "uname").write_text("#!/bin/sh\necho Linux\n")
    if has_gpu:
        (commands / "nvidia-smi").write_text("#!/bin/sh\n")
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(
        f'#!/bin/sh\ncase "$*" in *find_spec*) exit {int(not has_torch)};; *urlopen*) exit {int(not answers)};; esac\n'
        'echo "$@" > asked\n'
    )
    for each in (python, *commands.iterdir()):
        each.chmod(0o755)
    shell = shutil.which("sh")
    assert shell
    done = subprocess.run(
        [shell, str(SCRIPT), "dev"],
        cwd=tmp_path,
        env={"PATH": str(commands)},
        capture_output=True,
        text=True,
        check=True,
    )
    asked = (tmp_path / "asked").read_text()
    assert (CPU in asked) == cpu_build
    assert asked.rstrip().endswith("-c constraints.txt -e .[dev]")
    assert (said in done.stdout) if said else not done.stdout
