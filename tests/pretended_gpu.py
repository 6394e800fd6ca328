"""A pretended GPU: it computes on the CPU and counts what a GPU would be asked for, by the line that asked.

Its tensors wrap tensors of the CPU and say that they lie on another device. Torch has a name for a device that no build
of it has, and whose gradients are computed in the calling thread: ``lazy``.
"""

import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import lidargrit

DEVICE = torch.device("lazy")
_PACKAGE = str(Path(lidargrit.__file__).parent)
_READS = {"_local_scalar_dense", "nonzero", "equal", "masked_select", "_unique2", "unique_consecutive"}
_ALLOCATIONS = {"empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "lift_fresh"}


class PretendedTensor(Tensor):
    """A tensor of the pretended GPU.

    Args:
        on_cpu: the same tensor on the CPU.
    """

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, on_cpu: Tensor) -> "PretendedTensor":
        made = Tensor._make_wrapper_subclass(
            cls, on_cpu.shape, on_cpu.stride(), on_cpu.storage_offset(), dtype=on_cpu.dtype, device=DEVICE
        )
        made.on_cpu = on_cpu
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside of `counted()`")

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    def __getitem__(self, index: Any) -> Tensor:
        """Make tensors of lists of indices, which torch copies to the device unseen."""
        return super().__getitem__(_with_tensors(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        """Make tensors of lists of indices, as above."""
        super().__setitem__(_with_tensors(index), value)

    def new_tensor(self, data: Any, **kwargs: Any) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Upload numbers, which torch does unseen."""
        return torch.tensor(data, device=DEVICE, **{"dtype": self.dtype, **kwargs})

    def tolist(self) -> Any:
        """Copy it to the CPU first, as torch does for a GPU."""
        return self.cpu().tolist()


def _with_tensors(index: Any) -> Any:
    several = index if isinstance(index, tuple) else (index,)
    made = tuple(torch.tensor(each) if isinstance(each, list) else each for each in several)
    return made if isinstance(index, tuple) else made[0]


class Counts(TorchDispatchMode):
    """What the pretended GPU was asked for, each by file and line of the package.

    ``kernels`` are operations that are no views, ``reads`` are where the host waits for the device, and ``uploads`` are
    copies from the host.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kernels, self.reads, self.uploads = Counter[str](), Counter[str](), Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        given = list(_tensors_of((*args, *kwargs.values())))
        here = [each for each in given if isinstance(each, PretendedTensor)]
        name = func.overloadpacket.__name__
        to_device = kwargs.get("device")
        makes_here = to_device == DEVICE if to_device is not None else bool(here)
        if not (here or makes_here):
            return func(*args, **kwargs)
        self._count(func, name, args, given, here, makes_here)
        if to_device is not None:
            kwargs["device"] = torch.device("cpu")
        found = func(*map(_on_cpu, args), **{name: _on_cpu(value) for name, value in kwargs.items()})
        if (
            func._schema.is_mutable
            and func._schema.returns
            and args
            and isinstance(args[0], Tensor)
            and name[-1] == "_"
        ):
            return args[0]
        if "out" in kwargs:
            return kwargs["out"]
        if not makes_here or name in _READS - {"nonzero", "masked_select"}:
            return found
        return _on_gpu(found)

    def _count(
        self, func: Any, name: str, args: Any, given: list[Tensor], here: list[PretendedTensor], makes_here: bool
    ) -> None:
        line = _asked_from()
        if any(each.alias_info is not None and not each.alias_info.is_write for each in func._schema.returns):
            return  # a view
        away = [each for each in given if not isinstance(each, PretendedTensor) and each.ndim]
        if (name == "_to_copy" and not makes_here) or (name == "copy_" and not isinstance(args[0], PretendedTensor)):
            self.reads[line] += 1
            return
        if name in ("_to_copy", "copy_", "lift_fresh_copy") and away:
            self.uploads[line] += 1
            return
        if name in ("index", "index_put", "index_put_"):
            indices = [each for each in args[1] if each is not None]
            self.reads[line] += any(each.dtype == torch.bool for each in indices)
            self.uploads[line] += sum(not isinstance(each, PretendedTensor) for each in indices)
        elif away:
            raise RuntimeError(f"{func} of tensors on two devices, at {line}")
        self.reads[line] += name in _READS
        self.kernels[line] += name not in _ALLOCATIONS | {"_local_scalar_dense"}

    def __str__(self) -> str:
        """Return all three with the lines that ask the most often."""
        parts = {"kernels": self.kernels, "reads": self.reads, "uploads": self.uploads}
        return "\n".join(
            f"{what} {counts.total()}: " + ", ".join(f"{line} {n}" for line, n in counts.most_common(12) if n)
            for what, counts in parts.items()
        )


def _asked_from() -> str:
    """Return file and line of the package; kernels of gradients are asked for by torch alone."""
    frame = sys._getframe(3)
    while frame is not None and not frame.f_code.co_filename.startswith(_PACKAGE):
        frame = frame.f_back
    if frame is None:
        return "outside of the package"
    return f"{frame.f_code.co_filename.removeprefix(_PACKAGE + '/')}:{frame.f_lineno}"


def _tensors_of(values: Iterable[Any]) -> Iterator[Tensor]:
    for each in values:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, list | tuple):
            yield from _tensors_of(each)


def _on_cpu(value: Any) -> Any:
    if isinstance(value, PretendedTensor):
        return value.on_cpu
    return type(value)(map(_on_cpu, value)) if isinstance(value, list | tuple) else value


def _on_gpu(value: Any) -> Any:
    if isinstance(value, Tensor):
        return PretendedTensor(value)
    return type(value)(map(_on_gpu, value)) if isinstance(value, list | tuple) else value


class PretendedGenerator(torch.Generator):
    """A source of random numbers that says it is on the pretended GPU."""

    device = DEVICE


@contextmanager
def counted() -> Iterator[Counts]:
    """Let the pretended GPU work within the ``with`` block, and count."""
    autocast, tensor = torch.autocast, torch.tensor

    def autocast_here(device_type: str, *args: Any, **kwargs: Any) -> Any:
        return autocast("cpu" if device_type == DEVICE.type else device_type, *args, **kwargs)

    def tensor_here(data: Any, *, device: Any = None, **kwargs: Any) -> Tensor:
        made = tensor(data, **kwargs)
        return made if device is None else made.to(device)

    with patch.object(torch, "autocast", autocast_here), patch.object(torch, "tensor", tensor_here), Counts() as counts:
        yield counts
