"""Which module every exported node really belongs to, and what each module costs.

A module map guesses from names and from neighbours. Here it is known: its forward
passes say in which module they are (`models.regions`), and a second export
of the same stack writes that into the scopes of the nodes. Both exports trace the same
code, so node *i* of the marked file is node *i* of the plain one.
"""

import copy
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import onnx
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from me2e_compress.base.errors import GraphError
from models.export import build, example, trace
from models.regions import listening
from models.stacks import Stack, find

MARK = "region@"
"""Begins the scope that a region pushes, and @ ends the name of the module in it: no
attribute has an @, and the exporter appends a number when it enters a scope again."""

NOT_COMPUTE = frozenset({"Constant", "Identity"})
"""Nodes that hold or rename values; the exporter shares and places them freely."""

aten = torch.ops.aten

COUNTED = (aten.convolution, aten.mm, aten.addmm, aten.bmm, aten.baddbmm)
"""What becomes Conv, Gemm and MatMul."""

FLOPS_PER_MAC = 2


@dataclass(frozen=True)
class Truth:
    """What the trace recorded.

    Attributes:
        modules: Module of every compute node (all but Constant and Identity), by node
            name in the plain export.
        macs: Multiply-accumulates of one frame by module, counted by torch from the
            shapes that its convolutions and matrix products meet; nothing else counts.
    """

    modules: Mapping[str, str]
    macs: Mapping[str, int]


def record(
    stack: str, *, seed: int = 0, heads: str | None = None, opset: int = 17
) -> Truth:
    """Export a stack with and without marks, and count its MACs in one run.

    Raises:
        GraphError: Unknown stack, or the two exports differ in more than names.
    """
    model = build(stack, opset=opset, seed=seed, heads=heads)
    return truth_of(find(stack).with_heads(heads), model, opset)


def truth_of(
    spec: Stack,
    model: nn.Module,
    opset: int = 17,
    *,
    plain: onnx.ModelProto | None = None,
) -> Truth:
    """Record what the trace of a module knows, as `record` does of a stack.

    Args:
        spec: Of the stack.
        model: Its module.
        opset: Of the exports.
        plain: The export without marks, where there is one already.

    Raises:
        GraphError: The two exports differ in more than names.
    """
    if plain is None:
        plain = trace(spec, model, opset)
    with listening(_push_scope):
        marked = trace(spec, model, opset)
    return Truth(_align(plain, marked), count_macs(spec, model))


def _align(plain: onnx.ModelProto, marked: onnx.ModelProto) -> dict[str, str]:
    """Read the marks of one graph onto the nodes of the other."""
    ops = [[node.op_type for node in model.graph.node] for model in (plain, marked)]
    if ops[0] != ops[1]:
        raise GraphError(
            f"the marked export has other operators: {len(ops[0])} nodes against "
            f"{len(ops[1])}"
        )
    modules = {}
    for node, twin in zip(plain.graph.node, marked.graph.node, strict=True):
        if node.op_type in NOT_COMPUTE:
            continue
        marks = [part for part in twin.name.split("/") if part.startswith(MARK)]
        if not marks:
            raise GraphError(f"node {node.name} was traced outside of every region")
        modules[node.name] = marks[-1].split("@")[1]
    return modules


@contextmanager
def _push_scope(module: str) -> Iterator[None]:
    """Make the module a scope of what is traced."""
    state = torch._C._get_tracing_state()
    if state is None:
        yield
        return
    scope = torch._C._jit_onnx_create_full_scope_name("region", f"{MARK}{module}@")
    state.push_scope(scope)
    try:
        yield
    finally:
        state.pop_scope()


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


def count_macs(spec: Stack, model: nn.Module) -> dict[str, int]:
    """Return the multiply-accumulates of one forward pass by module.

    Raises:
        GraphError: Something multiplied outside of every region.
    """
    stack: list[str] = []
    macs: Counter[str] = Counter()

    @contextmanager
    def enter(module: str) -> Iterator[None]:
        stack.append(module)
        try:
            yield
        finally:
            stack.pop()

    def add(count: int) -> None:
        if not stack:
            raise GraphError(f"{spec.name} multiplies outside of every region")
        macs[stack[-1]] += count

    shapes_only = copy.deepcopy(model).to("meta")
    inputs = [tensor.to("meta") for tensor in example(spec)]
    with listening(enter), torch.no_grad(), MacCounter(add):
        shapes_only(*inputs)
    return dict(macs)
