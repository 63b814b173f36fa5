"""Count the multiply-accumulates of what torch runs."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

aten = torch.ops.aten

COUNTED = (aten.convolution, aten.mm, aten.addmm, aten.bmm, aten.baddbmm)
"""What becomes Conv, Gemm and MatMul."""

FLOPS_PER_MAC = 2


class MacCounter(TorchDispatchMode):
    """Tell a function the multiply-accumulates of every product that runs inside."""

    def __init__(self, add: Callable[[int], None]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._add = add

    def __torch_dispatch__(
        self,
        func: torch._ops.OpOverload,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Run the operator and count it."""
        options = dict(kwargs or {})
        out = func(*args, **options)
        packet = func._overloadpacket
        if packet in COUNTED:
            flops = flop_registry[packet](*args, **options, out_val=out)
            self._add(int(flops) // FLOPS_PER_MAC)
        return out
