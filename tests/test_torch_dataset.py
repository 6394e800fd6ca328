"""Images of every source through torch's own loaders."""

import re
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

import lidargrit
from lidargrit.cli import main
from lidargrit.data.sources import open_images
from lidargrit.systems.lidargrit.system import LidarGrit

SENSOR = lidargrit.load_sensor("hdl64e_kitti_odometry").with_columns(64)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """Return a source of each kind with its images read in another way."""
    folder = tmp_path_factory.mktemp("sources")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARGRIT_CACHE", str(folder / "cache"))
        words = ["--set", "data.columns=64", "--workers", "1"]
        assert main(["prepare", "simulated:6:train", "-o", str(folder / "prepared"), *words]) == 0
        LidarGrit(LidarGrit.smallest_config(SENSOR), SENSOR).save(folder / "run")
        assert main(["sample", str(folder / "run"), str(folder / "samples"), "-n", "2"]) == 0
        yield {"streets": "simulated:6:train", "prepared": folder / "prepared", "samples": folder / "samples"}


@pytest.mark.parametrize("kind", ["streets", "prepared", "samples"])
def test_items_are_the_images_of_the_source(sources, kind):
    source, sensor = str(sources[kind]), None if kind == "samples" else SENSOR
    dataset, images = lidargrit.torch_dataset(source, sensor), open_images(source, sensor)
    assert dataset.sensor.same_rays(images.sensor)
    whole = images.batch(range(len(images)))
    assert len(dataset) == len(images)
    for index in range(len(images)):
        item = dataset[index]
        assert set(item) == {"range_m", "return_mask", *whole.planes}
        assert torch.equal(item["range_m"], whole.range_m[index])
        assert torch.equal(item["return_mask"], whole.return_mask[index])
    assert torch.equal(dataset[-1]["range_m"], whole.range_m[-1])
    with pytest.raises(IndexError, match=f"image {len(images)} of {len(images)}"):
        dataset[len(images)]


def test_processes_of_a_loader_give_what_one_gives(sources):
    dataset = lidargrit.torch_dataset(str(sources["prepared"]), SENSOR)

    def batches(**options):
        order = torch.Generator().manual_seed(3)
        return [batch["range_m"] for batch in DataLoader(dataset, 4, shuffle=True, generator=order, **options)]

    alone, together = batches(), batches(num_workers=2, multiprocessing_context="spawn")
    assert [len(batch) for batch in alone] == [4, 2]
    assert all(torch.equal(one, other) for one, other in zip(alone, together, strict=True))


def test_a_loader_that_forks_is_told_what_to_do(sources):
    dataset = lidargrit.torch_dataset(str(sources["prepared"]), SENSOR)
    dataset[0]
    with pytest.raises(RuntimeError, match=r"was forked; wanted one that begins anew; give the loader multi"):
        next(iter(DataLoader(dataset, 2, num_workers=1, multiprocessing_context="fork")))


def test_the_network_of_the_page_learns(sources, monkeypatch):
    text = (Path(__file__).parent.parent / "docs" / "how-to" / "from-programs.md").read_text()
    (code,) = re.findall(r"```python\n(import torch\n.*?)```", text, re.DOTALL)
    code = code.replace(', num_workers=2, multiprocessing_context="forkserver"', "")
    code = code.replace("with_columns(1024)", "with_columns(64)").replace(
        "simulated:64:train", str(sources["prepared"])
    )
    torch.manual_seed(0)
    found: dict[str, torch.Tensor] = {}
    exec(compile(code.replace("for batch in loader:", "for batch in [*loader] * 30:"), "page", "exec"), found)
    assert found["loss"] < 0.3
