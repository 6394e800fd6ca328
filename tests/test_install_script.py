"""The installation: by pip or uv, and which build of torch is asked for, with and without a GPU and PyTorch's index."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "install.sh"
OTHERS = "*config* | *compileall*"  # of what python is asked that installs nothing
CPU = "--extra-index-url https://download.pytorch.org/whl/cpu"


def installed(folder, programs):
    """Run the script where there are only these programs, and ``python`` in ``.venv``."""
    commands, python = folder / "commands", folder / ".venv" / "bin" / "python"
    for place in (commands, python.parent):
        place.mkdir(parents=True)
    shell, grep = shutil.which("sh"), shutil.which("grep")
    assert shell
    assert grep
    (commands / "grep").symlink_to(grep)
    for name, text in {"uname": "echo Linux\n", **programs}.items():
        path = python if name == "python" else commands / name
        path.write_text(f"#!/bin/sh\n{text}")
        path.chmod(0o755)
    command, environment = [shell, str(SCRIPT), "dev"], {"PATH": str(commands)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)


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
    programs = {"nvidia-smi": ""} if has_gpu else {}
    checks = f"*find_spec*) exit {int(not has_torch)};; *urlopen*) exit {int(not answers)};; {OTHERS}) exit 0;;"
    done = installed(tmp_path, {**programs, "python": f'case "$*" in {checks} esac\necho "$@" > asked\n'})
    asked = (tmp_path / "asked").read_text()
    assert (CPU in asked) == cpu_build
    assert asked.rstrip().endswith("-c constraints.txt -e .[dev]")
    assert (said in done.stdout) if said else not done.stdout


@pytest.mark.skipif(shutil.which("sh") is None or os.uname().sysname != "Linux", reason="for Linux")
@pytest.mark.parametrize(
    ("uv_ends", "configured", "by"), [(0, "", "uv"), (2, "", "pip"), (0, "global.index-url='https://mirror'", "pip")]
)
def test_uv_installs_the_same_where_it_is_there_and_pip_has_no_settings_of_its_own(tmp_path, uv_ends, configured, by):
    checks = f'*find_spec*) exit 1;; *config*) echo "{configured}"; exit 0;; *urlopen* | {OTHERS}) exit 0;;'
    python = f'case "$*" in {checks} esac\n'
    programs = {
        "python": python + 'echo "pip $@" >> asked\n',
        "uv": f'echo "uv $@" >> asked\nexit {uv_ends}\n',
    }
    installed(tmp_path, programs)
    asked = (tmp_path / "asked").read_text().splitlines()
    assert asked[-1].startswith(by)
    assert all(CPU in line and line.endswith("-c constraints.txt -e .[dev]") for line in asked)
    if asked[0].startswith("uv"):
        assert "--python .venv/bin/python --index-strategy unsafe-best-match" in asked[0]
