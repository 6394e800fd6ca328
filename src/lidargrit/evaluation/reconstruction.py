"""Errors of a tokenizer's reconstructions: pairs of real and decoded range images → errors."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from lidargrit.core.errors import ConfigError, DataError, ScanError
from lidargrit.core.table import Table
from lidargrit.data.images import RangeImages
from lidargrit.generation.tokenizers import Tokenizer
from lidargrit.scans.types import RangeImage

_BATCH = 16
_OF_SCANS = ("abs_rel", "sq_rel_m", "scan_rmse_m", "rmse_log", "accuracy_1_25")  # means over scans
_LEAST_M = 1e-3  # of a decoded range in a logarithm or a ratio: ours are longer, others' may be 0 or negative


def errors_of_scans(
    real_range_m: Float[Tensor, "B H W"], decoded_range_m: Float[Tensor, "B H W"], return_mask: Bool[Tensor, "B H W"]
) -> dict[str, Float64[Tensor, " B"]]:
    """Return the measures of monocular depth estimation of each image, over its returns; NaN where it has none.

    ``abs_rel`` is the mean of |decoded - real| / real, ``sq_rel_m`` that of (decoded - real)^2 / real, ``scan_rmse_m``
    the root of the mean squared error in metres, ``rmse_log`` that of the natural logarithm of the range, and
    ``accuracy_1_25`` the share of returns with max(decoded / real, real / decoded) < 1.25. The program counts all
    pixels in the last while it trains and, as here, returns only when it reports.

    Source:
        Eigen et al., Depth map prediction from a single image, NeurIPS 2014, section 4; in metres, and image by image,
        as LidarGRIT reports them for its first stage.
    """
    real, apart = real_range_m.double(), decoded_range_m.double() - real_range_m
    above = decoded_range_m.double().clamp(min=_LEAST_M)
    ratio = above / real
    means = {
        "abs_rel": apart.abs() / real,
        "sq_rel_m": apart.square() / real,
        "scan_rmse_m": apart.square(),
        "rmse_log": (above.log() - real.log()).square(),
        "accuracy_1_25": (torch.maximum(ratio, 1 / ratio) < 1.25).double(),
    }
    found = {
        name: torch.where(return_mask, of, 0.0).sum((1, 2)) / return_mask.sum((1, 2)) for name, of in means.items()
    }
    return {name: of.sqrt() if "rmse" in name else of for name, of in found.items()}


@dataclass(frozen=True)
class ReconstructionErrors:
    """Errors of decoded against real range images, every pixel of every scan counting the same.

    Range errors are those of the decoder's clean range, before any ray is dropped, where the real scan has a return.
    The mask is scored as a search for rays without a return ("drop"): a share of nothing, such as the precision where
    no ray was dropped, is 1.

    Args:
        range_mae_m: mean absolute range error in metres; lower is better.
        range_rmse_m: root of the mean squared range error in metres; lower is better.
        mask_accuracy: share of pixels whose return or ray drop is decoded correctly; higher is better, here and in the
            next three.
        drop_precision: share of the decoded ray drops that are true.
        drop_recall: share of the true ray drops that are decoded.
        drop_iou: intersection over union of decoded and true ray drops.
        abs_rel: mean of |decoded - real| / real over the returns of a scan, as a mean over scans, like the next four;
            lower is better. LidarGRIT reports these five of its first stage.
        sq_rel_m: mean of (decoded - real)^2 / real in metres; lower is better.
        scan_rmse_m: root of the mean squared range error of a scan in metres; lower is better.
        rmse_log: root of the mean squared error of ln(range); lower is better.
        accuracy_1_25: share of returns with max(decoded / real, real / decoded) < 1.25; higher is better.
    """

    range_mae_m: float
    range_rmse_m: float
    mask_accuracy: float
    drop_precision: float
    drop_recall: float
    drop_iou: float
    abs_rel: float
    sq_rel_m: float
    scan_rmse_m: float
    rmse_log: float
    accuracy_1_25: float
    num_scans: int

    def table(self) -> Table:
        """Return a row for each error."""
        return Table(
            ("errors of reconstruction", "value"), tuple((name, f"{of:.4g}") for name, of in vars(self).items())
        )


class ReconstructionScore:
    """Gathers the errors of pairs batch by batch; the result does not depend on how they were batched or ordered."""

    def __init__(self) -> None:
        self._num_scans = 0
        # Counts of pixels: real and decoded ray drops as (real, decoded) = TT, FT, TF, FF.
        self._both = self._only_decoded = self._only_real = self._neither = 0
        self._absolute_m, self._squared_m2 = 0.0, 0.0
        self._of_scans, self._scans_with_returns = torch.zeros((), dtype=torch.float64), 0

    def update(
        self, real: RangeImage, clean_range_m: Float[Tensor, "B H W"], return_mask: Bool[Tensor, "B H W"]
    ) -> None:
        """Take in a batch of pairs.

        Args:
            real: batch of scans that the tokenizer encoded.
            clean_range_m: decoded range (B, H, W) of every pixel in metres, without ray drop.
            return_mask: decoded mask (B, H, W), True = a return.
        """
        if not real.range_m.shape == clean_range_m.shape == return_mask.shape:
            raise ConfigError(
                f"decoded ranges {tuple(clean_range_m.shape)} and masks {tuple(return_mask.shape)}",
                f"the shape of the real range images, {tuple(real.range_m.shape)}",
                "decode the batch that was encoded",
            )
        returned = real.return_mask
        error_m = (clean_range_m.detach()[returned].double() - real.range_m[returned].double()).abs()
        if not bool(error_m.isfinite().all()):
            raise ScanError(
                f"{int((~error_m.isfinite()).sum())} decoded ranges that are NaN or infinite",
                "finite metres",
                "check the weights of the tokenizer",
            )
        self._absolute_m += float(error_m.sum())
        self._squared_m2 += float(error_m.square().sum())
        self._both += int((~returned & ~return_mask).sum())
        self._only_decoded += int((returned & ~return_mask).sum())
        self._only_real += int((~returned & return_mask).sum())
        self._neither += int((returned & return_mask).sum())
        self._num_scans += len(real)
        has_returns = returned.any((1, 2))
        pairs = real.range_m[has_returns], clean_range_m.detach()[has_returns], returned[has_returns]
        self._of_scans = self._of_scans + torch.stack([of.sum() for of in errors_of_scans(*pairs).values()])
        self._scans_with_returns += int(has_returns.sum())

    def compute(self) -> ReconstructionErrors:
        """Return the errors over all pairs so far."""
        num_returns = self._only_decoded + self._neither
        if not num_returns:
            raise DataError(
                f"{self._num_scans} pairs of range images without one real return",
                "at least one pair with returns",
                "check the folder of real scans",
            )
        num_pixels = num_returns + self._both + self._only_real
        of_scans = (self._of_scans / self._scans_with_returns).tolist()
        return ReconstructionErrors(
            range_mae_m=self._absolute_m / num_returns,
            range_rmse_m=(self._squared_m2 / num_returns) ** 0.5,
            mask_accuracy=(self._both + self._neither) / num_pixels,
            drop_precision=_share(self._both, self._both + self._only_decoded),
            drop_recall=_share(self._both, self._both + self._only_real),
            drop_iou=_share(self._both, self._both + self._only_decoded + self._only_real),
            **dict(zip(_OF_SCANS, of_scans, strict=True)),
            num_scans=self._num_scans,
        )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 1.0


@torch.no_grad()
def score_reconstruction(tokenizer: Tokenizer, images: RangeImages) -> ReconstructionErrors:
    """Return how well a tokenizer reconstructs all images of a set; a pixel returns where its logit is 0 or more."""
    score, device = ReconstructionScore(), next(tokenizer.parameters()).device
    for first in range(0, len(images), _BATCH):
        batch = images.batch(range(first, min(first + _BATCH, len(images))))
        clean = tokenizer.decode(tokenizer.encode(batch.to(device)))
        score.update(batch, clean.range_m.cpu(), clean.return_logits.cpu() >= 0)
    return score.compute()
