"""A device that is none: tensors put on ``cuda`` stay where they are, and mixing them with those of the CPU fails as it does on a GPU.

For code that must run on CUDA and is tested where there is none. Which storages are "there" is kept; every torch function of Python's is
checked on its way in. Not in a backward pass, which runs in C++ on what the forward pass kept.
"""

from collections.abc import Callable
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

CUDA, CPU = torch.device("cuda", 0), torch.device("cpu")
#: What takes tensors of two devices on a GPU as well.
MIXING = ("copy_", "__setitem__", "__getitem__", "data.__set__", "_has_compatible_shallow_copy_type")


class OtherDevice(TorchFunctionMode):
    """While it is active, ``cuda`` is such a device."""

    def __init__(self):
        super().__init__()
        # Storages by address, tensors without elements by identity; kept alive, so that neither is used again.
        self.there: dict[int, object] = {}
        self.empty: dict[int, Tensor] = {}
        self.checking = True

    def holds(self, tensor: Tensor) -> bool:
        """Whether a tensor is on the device; called outside of the mode or within its handler."""
        return tensor.untyped_storage().data_ptr() in self.there if tensor.numel() else id(tensor) in self.empty

    def put(self, tensor: Tensor) -> Tensor:
        if tensor.numel():
            storage = tensor.untyped_storage()
            self.there[storage.data_ptr()] = storage
        else:
            self.empty[id(tensor)] = tensor
        return tensor

    @contextmanager
    def unchecked(self):
        before, self.checking = self.checking, False
        try:
            yield
        finally:
            self.checking = before

    def __torch_function__(self, func: Callable, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        owner = getattr(func, "__self__", None)
        name = f"{owner.__name__}.{func.__name__}" if func.__name__ in ("__get__", "__set__") and owner is not None else func.__name__
        if name in ("device.__get__", "is_cuda.__get__"):
            on_device = self.holds(args[0])
            return (CUDA if on_device else CPU) if name == "device.__get__" else on_device
        if name == "grad.__get__":
            grad = func(*args)
            return self.put(grad) if grad is not None and self.holds(args[0]) else grad
        if name == "backward":
            with self.unchecked():
                return func(*args, **kwargs)
        if name == "cuda":
            func, name, args = Tensor.to, "to", (args[0], CUDA)
        if name == "cpu":
            func, name, args = Tensor.to, "to", (args[0], CPU)
        target = None
        if name == "to":
            target, args, kwargs = self._target(args, kwargs)
        elif kwargs.get("device") is not None:
            target = torch.device(kwargs.pop("device"))
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = [self.holds(tensor) for tensor in tensors]
        if self.checking and target is None:
            self._check(name, tensors, there, kwargs)
        result = func(*args, **kwargs)
        if target is None and not any(there):
            return result
        if target is not None:
            moves = bool(tensors) and there[0] != (target.type == "cuda")
            result = tree_map(lambda leaf: leaf.clone() if moves and isinstance(leaf, Tensor) else leaf, result)
            if target.type != "cuda":
                return result
        return tree_map(lambda leaf: self.put(leaf) if isinstance(leaf, Tensor) else leaf, result)

    def _check(self, name: str, tensors: list[Tensor], there: list[bool], kwargs: dict) -> None:
        if name == "numpy" and there[0]:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first.")
        if any(there) and kwargs.get("generator") is not None:
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        if any(there) and "matmul" in name and not tensors[0].is_floating_point():
            raise NotImplementedError("\"addmv_impl_cuda\" not implemented for 'Long'")
        wrong = [tensor for tensor, on_device in zip(tensors, there, strict=True) if not on_device and tensor.dim()]
        if any(there) and wrong and not (name in MIXING and (name != "__getitem__" or there[0])):
            raise RuntimeError(f"{name}: expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!")

    def _target(self, args: tuple, kwargs: dict) -> tuple[torch.device | None, tuple, dict]:
        """The device that ``Tensor.to`` is asked for, and its arguments without it."""
        target, kept = None, [args[0]]
        for value in args[1:]:
            if isinstance(value, Tensor):
                target = CUDA if self.holds(value) else CPU
                kept.append(value.dtype)
            elif isinstance(value, str | torch.device):
                target = torch.device(value)
            elif isinstance(value, torch.dtype):  # else: None, or whether to wait
                kept.append(value)
        if kwargs.get("device") is not None:
            target = torch.device(kwargs["device"])
        return target, tuple(kept), {key: value for key, value in kwargs.items() if key != "device"}
