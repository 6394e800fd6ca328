"""Facts about a generative system: what it generates and where it comes from → lines for a person."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Annotated

from lidargrit.core.configuration import Settings
from lidargrit.core.typed_values import Bounds

_BATCH_AT_MOST = 4096  # scans: tens of GB of activations of the smallest networks

CAPABILITIES = {  # name → what a generator with it can do besides sampling, for messages
    "tokens": "turn scans into tokens and back",
    "encode": "encode scans and reconstruct them",
    "complete": "fill in the pixels of a scan that were not observed",
    "likelihood": "compute the likelihood of a scan",
}


@dataclass(frozen=True)
class SamplingSettings(Settings):
    """Settings that every generator has.

    Args:
        batch_size: number of scans that are computed at once, always; the last batch is filled up with copies. Another
            size sums in another order, so a seed gives the same scan only up to the last digits. 0 takes the system's
            own, which is the quickest for many scans on its device; 1 is the quickest for one scan alone.
    """

    batch_size: Annotated[int, Bounds(0, _BATCH_AT_MOST)] = field(default=0, kw_only=True)


@dataclass(frozen=True)
class Cost:
    """Cost of sampling one scan, counted and not timed, so the same on every machine.

    Args:
        network_evaluations: number of passes through a network, one after the other.
        flops: number of floating-point operations in products and convolutions, two for a multiply-add.
    """

    network_evaluations: int
    flops: int


@dataclass(frozen=True)
class SystemFacts:
    """What a generator writes and where its method comes from; ``lidargrit list generators`` prints it.

    Args:
        generates: values of a generated scan, and the rule by which a ray has no return.
        paper: authors, title, conference and year; empty for a method of this project.
        program: program of the authors, ``OWNER/REPOSITORY@COMMIT``, with its licence; empty where there is none.
        weights_licence: licence of the weights that the authors published; empty where they published none.
        first_command: command of ``lidargrit`` by which a trained run shows what it learned; ``RUN`` is its folder.
    """

    generates: str
    paper: str = ""
    program: str = ""
    weights_licence: str = ""
    first_command: str = "sample RUN samples -n 16"

    def lines(
        self, capabilities: Collection[str], sampling: Mapping[str, object], not_of_sampling: Collection[str]
    ) -> list[str]:
        """Return the facts as lines for a person, what a generator can do between them, and its settings behind them.

        Args:
            sampling: settings of sampling with their defaults, by their names.
            not_of_sampling: names of those settings that only completing a scan reads.
        """
        origin = "; ".join(part for part in (self.paper, self.program) if part) or "this project"
        settings = {
            "sample --set sampling.NAME": sampling.keys() - {*not_of_sampling},
            "complete --set sampling.NAME besides": {*not_of_sampling},
        }
        return [
            f"generates {self.generates}",
            *(f"can {what} ({name})" for name, what in CAPABILITIES.items() if name in capabilities),
            f"from: {origin}",
            f"published weights: {self.weights_licence or 'none'}",
            *(
                f"{verb}: {', '.join(f'{name}={value}' for name, value in sampling.items() if name in names)}"
                for verb, names in settings.items()
                if names
            ),
        ]
