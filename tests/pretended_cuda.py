"""A CUDA device that is pretended on the CPU: what is computed is right, and mixing devices is refused as CUDA does.

Tensors carry a mark; every call of PyTorch is looked at. A tensor made or moved to "cuda" is marked, what is
computed from marked tensors is marked, and a call that mixes marked and unmarked tensors (other than unmarked
numbers) or asks a marked one for its NumPy array is an error. What CUDA itself may do otherwise (other last bits,
kernels that are not deterministic, memory) it cannot show.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten

CUDA = torch.device("cuda")


class _Marks(TorchFunctionMode):
    """Marks tensors and refuses what a CUDA device would refuse."""

    marked = 0  # tensors so far

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = getattr(func, "__name__", ""), dict(kwargs or {})
        tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
        there = [t for t in tensors if _is_marked(t)]
        if func == torch.Tensor.device.__get__:
            return CUDA if there else func(*args, **kwargs)
        if func == torch.Tensor.is_cuda.__get__:
            return bool(there)
        if func == torch.Tensor.grad.__get__:
            return self._mark(func(*args, **kwargs)) if there else func(*args, **kwargs)
        if func == torch.Tensor.data.__set__:
            func(*args, **kwargs)
            args[0].pretended = _is_marked(args[1])
            return None
        if there and name in ("numpy", "__array__"):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        strangers = [t for t in tensors if not _is_marked(t) and t.ndim > 0]
        if there and strangers and name not in ("copy_", "_has_compatible_shallow_copy_type"):
            raise RuntimeError(f"{name}: expected all tensors to be on the same device, found cuda:0 and cpu")
        target = kwargs.get("device")
        if name in ("cuda", "cpu"):
            target, func, args = name, torch.Tensor.clone, args[:1]
        elif name == "to":
            target = next((a for a in args[1:] if isinstance(a, str | torch.device)), target)
            types = [a for a in (*args[1:], kwargs.get("dtype")) if isinstance(a, torch.dtype)]
            func, args, kwargs = torch.Tensor.to, (args[0], *(types or [args[0].dtype])), {"copy": True}
        kwargs.pop("device", None)
        found = func(*args, **kwargs)
        if target is not None:
            return self._mark(found, torch.device(target).type == "cuda")
        return self._mark(found) if there else found

    def _mark(self, found: Any, there: bool = True) -> Any:
        for tensor in tree_flatten(found)[0]:
            if isinstance(tensor, torch.Tensor):
                tensor.pretended = there
                self.marked += there
        return found


class _Source(torch.Generator):
    """A generator of random numbers that says it is on the CUDA device."""

    device = property(lambda self: CUDA)  # type: ignore[assignment]

    def __new__(cls, device: torch.device) -> _Source:
        return super().__new__(cls, "cpu")


def _is_marked(tensor: torch.Tensor) -> bool:
    return bool(tensor.__dict__.get("pretended", False))


@contextmanager
def pretended_cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[_Marks]:
    """Return a context in which there seems to be a CUDA device; `marked` counts the tensors that were on it."""
    with monkeypatch.context() as patch, _Marks() as marks:
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch, "Generator", _Source)
        yield marks
