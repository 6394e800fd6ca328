"""Does every system train and sample on this device, and does a seed give the scan that a CPU gives? One line each.

python benchmarks/gpu_smoke.py [--device cuda]
"""

import argparse
import time
from pathlib import Path

import torch

from lidargrit.api import load
from lidargrit.core import discovery
from lidargrit.generation.generator import Generator, load_class
from lidargrit.scans.condition import Nothing, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.training.compute import uniform_images

_SEED = 7
_FLIPPED_M = 0.1  # a range that differs by more is another surface's


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(parser.parse_args().device)
    for name in discovery.names("generators"):
        report(f"{name}, two steps of each stage and one scan", lambda name=name: two_steps(load_class(name), device))
    packaged = Path(__file__).parent.parent / "src" / "lidargrit"
    for name in ("pretrained", "pretrained_wide"):
        report(f"{name}, seed {_SEED} beside the CPU's scan", lambda name=name: beside_cpu(packaged / name, device))


def report(what, check) -> None:
    """Print what a check found, or how it failed, and the seconds that it took."""
    begun = time.perf_counter()
    try:
        found = check()
    except Exception as error:  # whatever it is, the next one is tried
        found = f"FAILED: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    print(f"{what}: {found} ({time.perf_counter() - begun:.1f} s)", flush=True)


def two_steps(cls: type[Generator], device: torch.device) -> str:
    """Train every stage of the smallest configuration for two steps, sample, and say what the losses were."""
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(32, 1)
    torch.manual_seed(0)
    generator, images = cls(cls.smallest_config(sensor), sensor), uniform_images(sensor, 2)
    if not generator.stages:
        return "no network"
    losses = []
    for stage in generator.stages:
        objective = generator.objective(stage).to(device).train()
        optimiser = torch.optim.AdamW(objective.parameters(), 1e-4)
        for step in range(2):
            for player in objective.players or ("",):
                rng = torch.Generator(device).manual_seed(step)
                loss = objective(Example(images.to(device)), rng, player)["loss"]
                loss.backward()
                optimiser.step()
                optimiser.zero_grad()
        losses.append(f"{stage} {float(loss.detach()):.3g}")
        generator.load_stage(stage, objective.cpu().eval())
    generator.to(device).eval()
    if Nothing not in generator.takes:
        surfaces = "pixels" not in generator.conditions
        some = Observed.of_surfaces(images) if surfaces else Observed.of_pixels(images, images.range_m > 20)
        scan = generator.complete(some[:1].to(device), [_SEED])
    else:
        scan = generator.sample([_SEED], sampling=cls.quickest_sampling())
    return f"{'; '.join(losses)}; {float(scan.return_mask.float().mean()):.0%} of the rays return"


def beside_cpu(folder: Path, device: torch.device) -> str:
    """Sample one seed on both devices, and say in how many pixels they differ."""
    model = load(str(folder))
    on_cpu = model.sample([_SEED])
    on_device: RangeImage = model.to(device).sample([_SEED]).to("cpu")
    flipped_returns = int((on_cpu.return_mask != on_device.return_mask).sum())
    both = on_cpu.return_mask & on_device.return_mask
    error_m = (on_cpu.range_m - on_device.range_m).abs()[both]
    same = error_m[error_m <= _FLIPPED_M]
    return (
        f"{flipped_returns} returns and {int((error_m > _FLIPPED_M).sum())} ranges of {both.numel()} pixels flipped, "
        f"the others within {float(same.max()):.1e} m"
    )


if __name__ == "__main__":
    main()
