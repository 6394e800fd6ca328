"""What is shipped: the wheel has every file of the package, and the container's preset names what is there."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def try_wheel():
    spec = importlib.util.spec_from_file_location("try_wheel", ROOT / "tests" / "package" / "try_wheel.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not importlib.util.find_spec("hatchling"), reason="needs hatchling, which builds the wheel")
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs git to know which files are the package's")
def test_the_wheel_has_every_file(tmp_path):
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert try_wheel().missing(wheel) == []
    assert wheel.stat().st_size < 40_000_000, "beyond that, weights would be a file to fetch"


def test_the_container_gets_what_its_preset_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    copied = [words.split()[:-1] for words in re.findall(r"^COPY (.+)$", DOCKERFILE, re.MULTILINE)]
    names = {name for part in copied for name in part}
    let_in = set(re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(encoding="utf-8"), re.MULTILINE))
    assert names == let_in == {"pyproject.toml", "constraints.txt", project["readme"], *project["license-files"], "src"}
    extras = re.findall(r"\[([\w,]+)\]\"", DOCKERFILE)
    assert set(",".join(extras).split(",")) <= project["optional-dependencies"].keys()
    version = re.search(r"^FROM python:(\d+\.\d+)-slim$", DOCKERFILE, re.MULTILINE)
    assert version is not None
    assert float(version[1].replace("3.", "")) >= 11
    assert re.search(r"^USER (?!root)", DOCKERFILE, re.MULTILINE)
    assert DOCKERFILE.rstrip().endswith('ENTRYPOINT ["lidargrit"]')


def test_without_any_extra_all_formats_and_data_sets_are_known():
    """In a process of its own, in which the packages of the extras cannot be imported."""
    extras = ("constriction", "h5py", "huggingface_hub", "laspy", "mcap", "ouster", "pyarrow", "rosbags", "wandb")
    script = f"""
import sys
sys.modules.update(dict.fromkeys({extras}))
from lidargrit.core import discovery
from lidargrit.data import datasets, formats
for load, kind in ((formats.load, "formats"), (datasets.load, "datasets")):
    print(len([load(name) for name in discovery.names(kind)]))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(int(count) > 5 for count in done.stdout.split())
