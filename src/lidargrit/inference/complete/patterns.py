"""Which pixels of a scan are taken as observed: words such as rows:4, or a file → a mask."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from lidargrit.core.arrays import parse_array
from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import ScanError, UsageError
from lidargrit.inference.complete.grid import phase_seed
from lidargrit.scans.types import RangeImage

FORMS = "rows:4, sector:45,315, pixels:0.1, returns or a mask.npy"
_OF_PIXELS = 0x6D61736B  # keeps the random numbers of masks apart from those of a completion with the same seed
_BYTES_AT_MOST = 1 << 26  # a mask of 64-bit numbers of the largest image


@dataclass(frozen=True)
class Pattern:
    """Pixels of a scan that are observed; all others are to be generated.

    Args:
        text: pattern as a user types it. ``rows:N`` keeps every N-th row, ``sector:A,B`` the azimuths from A
            counter-clockwise to B degrees (0 is ahead), ``pixels:SHARE`` a random share, ``returns`` the pixels with a
            return, and a path of an ``.npy`` of (H, W) the pixels that are not 0 in it.
    """

    text: str

    def __post_init__(self) -> None:
        if self.text.partition(":")[0] in ("rows", "sector", "pixels"):
            self._numbers()
        elif self.text != "returns" and not self.text.lower().endswith(".npy"):
            raise UsageError(f"--observed {self.text[:80]}", FORMS, "choose one")

    @property
    def partial(self) -> bool:
        """Whether scans of a part of the circle are accepted, because pixels without a return count as unobserved."""
        return self.text == "returns"

    def identity(self) -> dict[str, str]:
        """Return what identifies the pattern, as JSON: another mask may be put in place of one."""
        if not self.text.lower().endswith(".npy"):
            return {"observed": self.text}
        array = _read(Path(self.text), "an .npy of truth values, one for each pixel")
        content = f"{array.shape} {array.dtype}".encode() + array.tobytes()
        return {"observed": self.text, "observed_sha256": hashlib.sha256(content).hexdigest()}

    def mask(self, image: RangeImage, seed: int = 0, source: str = "a scan") -> Bool[Tensor, "H W"]:
        """Return the mask of the observed pixels of one range image; see :meth:`masks`."""
        return self.masks(RangeImage.stack([image]), seed, source)[0]

    def masks(self, images: RangeImage, seed: int = 0, source: str = "a scan") -> Bool[Tensor, "P H W"]:
        """Return the masks of the observed pixels of the images that one scan consists of.

        Args:
            seed: seed of the pixels that ``pixels:SHARE`` chooses; each further image has others.
        """
        masks = torch.stack([self._mask(images[at], phase_seed(seed, at)) for at in range(len(images))])
        if self.text == "returns" and bool(masks.all()):
            raise ScanError(f"{source}, in which every pixel has a return", "some without", "leave the scan out")
        if bool(masks.all()):
            got = f"--observed {self.text}, by which all pixels are observed"
            raise UsageError(got, "some pixels that are not", "choose other pixels")
        if not bool((masks & images.return_mask).any()):
            got = f"{source}, of which --observed {self.text} observes no return"
            raise ScanError(got, "some returns that are observed", "choose other pixels, or leave the scan out")
        return masks

    def _mask(self, image: RangeImage, seed: int) -> Bool[Tensor, "H W"]:
        height, width = image.range_m.shape
        mask = torch.zeros(height, width, dtype=torch.bool)
        if self.text == "returns":
            return image.return_mask.cpu()
        if self.text.startswith("rows:"):
            every = int(self._numbers()[0])
            mask[every // 2 :: every] = True
            return mask
        if self.text.startswith("sector:"):
            first, last = self._numbers()
            azimuth_deg = image.sensor.azimuth_rad.cpu().double().rad2deg().expand(height, width)
            return (azimuth_deg - first) % 360 <= ((last - first) % 360 or 360)
        if self.text.startswith("pixels:"):
            rng = torch.Generator().manual_seed(derive_seed(seed, _OF_PIXELS))
            return torch.rand(height, width, generator=rng) < self._numbers()[0]
        return _read_mask(Path(self.text), (height, width))

    def _numbers(self) -> list[float]:
        name, _, rest = self.text.partition(":")
        wanted, count = {
            "rows": ("rows:N with a whole N from 2 to 64", 1),
            "sector": ("sector:A,B with two different angles, in degrees from -360 to 360", 2),
            "pixels": ("pixels:SHARE between 0 and 1", 1),
        }[name]
        try:
            numbers = [float(word) for word in rest.split(",")]
        except ValueError:
            numbers = []
        fits = (
            len(numbers) == count
            and {
                "rows": lambda: numbers[0] in range(2, 65),
                "sector": lambda: all(-360 <= number <= 360 for number in numbers) and numbers[0] != numbers[1],
                "pixels": lambda: 0 < numbers[0] < 1,
            }[name]()
        )
        if not fits:
            raise UsageError(f"--observed {self.text[:80]}", wanted, "correct it")
        return numbers


def _read_mask(path: Path, size: tuple[int, int]) -> Bool[Tensor, "H W"]:
    wanted = f"an .npy of {size[0]}x{size[1]} truth values, one for each pixel"
    array = _read(path, wanted)
    if array.shape != size or array.dtype.kind not in "buif":
        got = f"--observed {path}, a mask of {'x'.join(map(str, array.shape))} {array.dtype}"
        raise UsageError(got, wanted, "make a mask for this sensor")
    return torch.from_numpy(np.asarray(array != 0))


def _read(path: Path, wanted: str) -> np.ndarray:
    try:
        if not path.is_file():
            raise ValueError("it is no file")
        if path.stat().st_size > _BYTES_AT_MOST:
            raise ValueError("it is too large")
        return parse_array(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UsageError(f"--observed {path}, which cannot be used ({error})", wanted, "check the file") from None
