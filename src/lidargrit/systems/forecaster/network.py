"""What a pixel decoder is told by the past of a drive: returns on the rays of the present scan → features, ranges."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.generation.pixel_decoder.range_network import bounded_difference
from lidargrit.nn.blocks import Network, zeroed
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, Decoded
from lidargrit.scans.warp import WarpedPast

COMPONENTS = 3  # of a range, which begin at the surface, the return that is best aligned, and that of the last scan
_CYCLES = (1, 2, 4, 8)  # of the sine and cosine that tell a column
_MAPS = 3 + 3 * 5 + 4 + 2 * len(_CYCLES)
_HEAD_STARTS = (0.0, -1.0, -1.0)  # logits of these components
_MISSING = -8.0  # of a component without a return
_LOG_SCALE_M = -3.0  # 5 cm
_NEAR_M = 0.02  # a spread that is half of a large one
_AGE_S = 2.0  # of a map of ages


class PastNetwork(Network):
    """Features of every pixel, and the logit of a return, from maps of the returns that past scans have there.

    A logit is a correction of the usual one of its ray (``usual``): the own car hides the same rays in every scan.

    Args:
        scans: number of past scans.
    """

    def __init__(self, rows: int, columns: int, width: int, blocks: int, scans: int) -> None:
        super().__init__()
        self.scans = scans
        self.rows = nn.Parameter(torch.zeros(width, rows, 1))
        self.conv_in = Convolution(_MAPS, width, "wrap")
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.logit = zeroed(nn.Conv2d(width, 1, 1))
        self.register_buffer("usual", torch.zeros(rows, columns))

    usual: Tensor

    def forward(self, maps: Float[Tensor, "B M H W"]) -> tuple[Float[Tensor, "B C H W"], Float[Tensor, "B H W"]]:
        """Return features of every pixel, and the logits of returns."""
        x = F.silu(self.blocks(self.conv_in(maps) + self.rows))
        return x, self.logit(x)[:, 0] + self.usual

    def told(self, warped: WarpedPast, sensor: SensorModel) -> Decoded:
        """Return what the past tells of each pixel of the present scans; ranges are 0 where it tells none."""
        kind = self.conv_in.weight.dtype
        features, logits = self(maps_of(warped, self.scans, sensor).to(kind))
        expected_m = warped.surface.range_m
        ranges_m = torch.stack((expected_m, warped.aligned.range_m, warped.last.range_m), 1)
        there = ranges_m > 0
        v = torch.where(there, ranges_m, expected_m[:, None]).log1p()
        centres = v.where((expected_m > 0)[:, None], TYPICAL_LOG_RANGE).to(kind)
        starts = torch.where(there, centres.new_tensor(_HEAD_STARTS)[:, None, None], _MISSING)
        components = torch.stack((starts, centres, _LOG_SCALE_M - centres), 1)
        return Decoded(expected_m.to(kind), logits, sensor, features=features, components=components)

    def flops(self, sensor: SensorModel) -> int:
        """Return the floating-point operations of one scan."""
        weights = sum(weight.numel() for weight in self.parameters() if weight.ndim == 4)
        return 2 * sensor.height * sensor.width * weights


def maps_of(warped: WarpedPast, past_scans: int, sensor: SensorModel) -> Float[Tensor, "B M H W"]:
    """Return the past as maps of numbers near 0, which are 0 where there is no return.

    They are of the surface its range, the number of its returns and their spread; of each layer of returns whether
    there is one, the cosine of incidence, the angle from the ray, the age, and the range beside that of the surface;
    then the last scan as it was, in how many scans there is a return, and where the column is.
    """
    surface, copied_m = warped.surface, warped.copied_m
    seen, v = surface.range_m > 0, surface.range_m.log1p()

    def beside_surface(range_m: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
        return torch.where(seen & (range_m > 0), bounded_difference(range_m.log1p() - v), 0.0)

    maps = [torch.where(seen, v - TYPICAL_LOG_RANGE, 0.0), surface.returns.to(v).clamp(max=20) / 10]
    maps.append(surface.spread_m / (surface.spread_m + _NEAR_M))
    fine_columns = sensor.width * sensor.column_stride
    for layer in (warped.nearest, warped.aligned, warped.last):
        offset = layer.offset_rad * (fine_columns / (2 * math.pi))
        maps += [layer.mask.to(v), layer.cos_incidence, offset.clamp(max=4), layer.age_s.clamp(max=4) / _AGE_S]
        maps.append(beside_surface(layer.range_m))
    maps += [(copied_m > 0).to(v), torch.where(copied_m > 0, copied_m.log1p() - TYPICAL_LOG_RANGE, 0.0)]
    turns = [wave(cycles * sensor.azimuth_rad) for cycles in _CYCLES for wave in (torch.sin, torch.cos)]
    maps += [beside_surface(copied_m), warped.scans.to(v) / past_scans, *(turn.to(v).expand_as(v) for turn in turns)]
    return torch.stack(maps, 1)
