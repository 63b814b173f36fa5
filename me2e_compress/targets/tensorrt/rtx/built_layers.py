"""Read off a built plan which layers got int8 operands.

The plan is a binary file that carries readable text for each kernel; its form is not
documented. It is read to confirm what the quantization plan promises, and for nothing
else: where the form changes no kernels are found, and that is reported.
"""

import dataclasses
import re
from collections.abc import Iterable

_KERNEL = re.compile(
    r"(corrltn|deconvolution|fully_connected)=\{ name=\"([^\"]+)\" output=\{([^}]*)\}"
    r" input=\{([^}]*)\}"
)
_TENSOR = re.compile(r'name="([^"]+)"[^}]*?(?:\{[^}]*\}[^}]*?)*type=(\w+) \}')
_WORD = re.compile(r'"([^"]+)"')
_KINDS = {
    "corrltn": "convolution",
    "deconvolution": "deconvolution",
    "fully_connected": "product",
}


@dataclasses.dataclass(frozen=True)
class Kernel:
    """One convolution or matrix product of a built plan.

    Attributes:
        kind: ``convolution``, ``deconvolution`` or ``product``.
        nodes: names of the ONNX nodes that it computes; merged ones together.
        operands: element types of its first two operands, ``?`` if not said.
    """

    kind: str
    nodes: tuple[str, ...]
    operands: tuple[str, ...]

    @property
    def is_int8(self) -> bool:
        """Whether both operands are int8."""
        return self.operands == ("int8", "int8")


def read_kernels(plan: bytes) -> tuple[Kernel, ...]:
    """Find the convolutions and products in the text of a plan."""
    text = plan.decode("latin1")
    types = dict(_TENSOR.findall(text))
    return tuple(
        Kernel(
            _KINDS[kind],
            tuple(name.split("+")),
            tuple(types.get(word, "?") for word in _WORD.findall(operands)[:2]),
        )
        for kind, name, _, operands in _KERNEL.findall(text)
    )


def without_int8(nodes: Iterable[str], kernels: Iterable[Kernel]) -> tuple[str, ...]:
    """Name the nodes that no int8 kernel of the plan computes."""
    done = {name for kernel in kernels if kernel.is_int8 for name in kernel.nodes}
    return tuple(name for name in nodes if name not in done)
