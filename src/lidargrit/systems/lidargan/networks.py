"""LidarGAN's two convolutional networks, and the losses of GAN and VAE: latents → images, images → vectors."""

from pathlib import Path
from typing import Annotated

from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.errors import CheckpointError
from lidargrit.core.typed_values import Bounds
from lidargrit.nn.blocks import Network
from lidargrit.nn.published import read_checkpoint

IMAGE_CHANNELS = 2  # horizontal distance and height
_BYTES_AT_MOST = 1 << 29  # the largest published network takes 120 MB


_SLOPE = 0.2  # of the leaky rectifier below 0

InitialStd = Annotated[float, Bounds(above=0, most=1)]  # of new weights


class Decoder(Network):
    """Latents → images with values between -1 and 1.

    A transposed convolution spreads the latent over a grid of n x w pixels, the next one makes (2n + 1) x 2w of it, and
    three more double both: 2x16, 5x32, 10x64, 20x128, 40x256. Batch norm follows all but the last. Names of weights are
    the program's.

    Args:
        channels: number of channels of the finest level; each of the three coarser levels has twice as many.
        size: rows and columns of the image; see lidargrit.systems.lidargan.filled_rows.

    Source:
        Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019; sizes from
        pclucas14/lidar_generation@2a2c8bc.
    """

    def __init__(self, latent_dim: int, channels: int, size: tuple[int, int], initial_std: float = 0.02) -> None:
        super().__init__()
        widths = [channels << level for level in (3, 2, 1, 0)]
        kernels = [_coarsest(size), (3, 4), (4, 4), (4, 4), (4, 4)]
        layers: list[nn.Module] = []
        for level, (inputs, outputs) in enumerate(zip([latent_dim, *widths], [*widths, IMAGE_CHANNELS], strict=True)):
            stride, padding = _step(level)
            layers.append(nn.ConvTranspose2d(inputs, outputs, kernels[level], stride, padding, bias=False))
            layers += [nn.BatchNorm2d(outputs), nn.ReLU()] if level < len(widths) else [nn.Tanh()]
        self.main = nn.Sequential(*layers)
        _start(self, initial_std)

    def forward(self, latents: Float[Tensor, "B D"]) -> Float[Tensor, "B 2 H W"]:
        """Generate images."""
        return self.main(latents[..., None, None]).float()


class Encoder(Network):
    """Images → vectors: one number for the discriminator, or the mean and log-variance of a latent for the encoder.

    Its convolutions are those of :class:`Decoder` in the opposite order.

    Args:
        channels: number of channels of the finest level; each of the three coarser levels has twice as many.
    """

    def __init__(self, outputs: int, channels: int, size: tuple[int, int], initial_std: float = 0.02) -> None:
        super().__init__()
        widths = [channels << level for level in (0, 1, 2, 3)]
        kernels = [(4, 4), (4, 4), (4, 4), (3, 4)]
        layers: list[nn.Module] = []
        for level, (inputs, width) in enumerate(zip([IMAGE_CHANNELS, *widths], widths, strict=False)):
            stride, padding = _step(len(widths) - level)
            layers.append(nn.Conv2d(inputs, width, kernels[level], stride, padding, bias=False))
            layers += [nn.BatchNorm2d(width)] if level else []
            layers.append(nn.LeakyReLU(_SLOPE))
        self.main = nn.Sequential(*layers)
        self.out = nn.Conv2d(widths[-1], outputs, _coarsest(size), bias=False)
        _start(self, initial_std)

    def forward(self, images: Float[Tensor, "B 2 H W"]) -> Float[Tensor, "B outputs"]:
        """Return one vector for each image."""
        return self.out(self.main(images)).float()[..., 0, 0]


def _coarsest(size: tuple[int, int]) -> tuple[int, int]:
    return (size[0] // 8 - 1) // 2, size[1] // 16


def _step(level: int) -> tuple[int, tuple[int, int]]:
    """Return stride and padding of a transposed convolution, 0 being the coarsest level."""
    return (1, (0, 0)) if level == 0 else (2, (0, 1)) if level == 1 else (2, (1, 1))


def _start(network: nn.Module, initial_std: float) -> None:
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
            nn.init.normal_(module.weight, 0.0, initial_std)
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.weight, 1.0, initial_std)


def relativistic_loss(of_own: Float[Tensor, "B"], of_other: Float[Tensor, "B"]) -> Tensor:
    """Return a player's least-squares loss: outputs are wanted 1 above the other images' mean, and theirs 1 below.

    Args:
        of_own: discriminator's outputs for the images that the player wants to look real.
        of_other: outputs for the other images.

    Source:
        Jolicoeur-Martineau, The relativistic discriminator, 2019.
    """
    above, below = of_own - of_other.mean() - 1, of_other - of_own.mean() + 1
    return (above.square().mean() + below.square().mean()) / 2


def kl_nats(mean: Float[Tensor, "B D"], log_variance: Float[Tensor, "B D"]) -> Float[Tensor, "B"]:
    """Return the Kullback-Leibler divergence of each latent's normal distribution from the standard one."""
    return (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=1) / 2


def vae_loss(
    images: Float[Tensor, "B 2 H W"],
    reconstructed: Float[Tensor, "B 2 H W"],
    kl: Float[Tensor, "B"],
    kl_weight: float | Tensor,
    free_nats: float,
) -> dict[str, Tensor]:
    """Return ``loss``, the absolute error summed over the values of an image plus the weighted divergence, and both.

    Args:
        kl: divergence of each latent.
        kl_weight: weight of the divergence, from 0 to 1.
        free_nats: divergence of a latent, in nats, below which it adds nothing to the loss.
    """
    error = (reconstructed - images).abs().sum(dim=(1, 2, 3)).mean()
    loss = error + kl_weight * kl.clamp(min=free_nats).mean()
    return {"loss": loss, "absolute_error": error.detach(), "kl_nats": kl.detach().mean()}


def read_published_sizes(path: Path, what: str, first: str, image: str) -> tuple[dict[str, Tensor], int, int]:
    """Read a file of weights that LidarGAN's program saved, which tells its own sizes.

    The file does not tell the scale of the images: it is 41.1245 m, the farthest that the box around the car reaches,
    which the largest coordinate of many scans is next to.

    Args:
        what: network that the file holds, in words.
        first: name of the decoder's first layer.
        image: name of the layer at the image, of the decoder or the encoder.

    Returns:
        weights by their names, length of a latent, and number of channels of the finest level.
    """
    weights = read_checkpoint(path, (), _BYTES_AT_MOST)
    try:
        (latent_dim, *_), (channels, image_channels, *_) = (weights[f"{name}.weight"].shape for name in (first, image))
    except (KeyError, ValueError):
        got = f"{path}, which holds no {what} of LidarGAN's authors"
        raise CheckpointError(got, "one that their program saved", "check the path") from None
    if image_channels != IMAGE_CHANNELS:
        got = f"{path}, whose images have {image_channels} coordinates"
        raise CheckpointError(got, "distance and height", "use another file")
    return weights, latent_dim, channels
