"""Check that a fused operator's body, reference and shapes agree."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of
from me2e_compress.operators import (
    OPERATORS,
    OWN_DOMAIN,
    Dialect,
    FusedCall,
    Operand,
    Operator,
    expand,
    import_domains,
    set_output,
    translate,
)
from me2e_compress.operators.call import AttributeValue
from me2e_compress.operators.dialect import INTEGERS, NdArray, present
from me2e_compress.runtime.session import run_once
from me2e_compress.testing.form import check_form, require

_LARGEST_SIZE, _LARGEST_RANK = 5, 4


@dataclasses.dataclass(frozen=True)
class DrawnCall:
    """The inputs, by name in the dialect's order, and attributes of one call."""

    inputs: Mapping[str, NdArray]
    attributes: Mapping[str, AttributeValue] = dataclasses.field(default_factory=dict)


Draw: TypeAlias = Callable[[Dialect, np.random.Generator], DrawnCall]


def draw_call(dialect: Dialect, random: np.random.Generator) -> DrawnCall:
    """Draw a call from what a dialect declares of its operands and attributes.

    A letter among the dimensions is one size in all operands; floats are normal,
    integers 0 to 4; an attribute is one of its choices, or its default.
    """
    sizes: dict[str, int] = {}
    inputs = {o.name: _array(o, sizes, random) for o in dialect.operands}
    attributes = {
        attribute.name: attribute.choices[random.integers(len(attribute.choices))]
        if attribute.choices
        else attribute.default
        for attribute in dialect.attributes
    }
    return DrawnCall(inputs, attributes)


def one_node_model(call: DrawnCall, dialect: Dialect, opset: int) -> ir.Model:
    """Build the graph of one node whose inputs are those of the graph."""
    values = [
        ir.val(name, ir.DataType.from_numpy(array.dtype), array.shape)
        for name, array in call.inputs.items()
    ]
    # one node with one output, in a graph of two opset imports
    node = ir.node(
        dialect.op_type,
        values,
        call.attributes,
        domain=dialect.domain,
        name=dialect.op_type,
        num_outputs=1,
    )
    node.outputs[0].name = "result"
    imports = {dialect.domain: 1, "": opset}
    graph = ir.Graph(
        values, node.outputs, nodes=[node], opset_imports=imports, name="one_call"
    )
    return ir.Model(graph, ir_version=9)


def _array(
    operand: Operand, sizes: dict[str, int], random: np.random.Generator
) -> NdArray:
    """Draw an operand; letters that get a size are added to ``sizes``."""
    dims = operand.dims
    # a digit is a size, a letter one size in all operands, * any size
    letters = ["*"] * random.integers(1, _LARGEST_RANK + 1)
    shape = []
    for letter in letters if dims is None else dims.split():
        size = int(random.integers(1, _LARGEST_SIZE + 1))
        if letter.isdigit():
            size = int(letter)
        elif letter != "*":
            size = sizes.setdefault(letter, size)
        shape.append(size)
    # values of the first type that the operand allows
    kind = operand.types[0]
    if kind in INTEGERS:
        return random.integers(0, 5, shape).astype(kind.numpy())
    return random.normal(size=shape).astype(kind.numpy())


def dialect_reference(operator: Operator, dialect: Dialect, call: DrawnCall) -> NdArray:
    """Compute a call in float64: the reference between the dialect's conversions."""
    inputs = {
        name: array.astype(np.float64) if array.dtype.kind == "f" else array
        for name, array in call.inputs.items()
    }
    # a node of the dialect gives its attributes and its place to one that can run
    graph = one_node_model(DrawnCall(inputs, call.attributes), dialect, OPSETS[0]).graph
    node, place = graph[0], ir.node("Identity", graph.inputs[:1])
    attributes, given = dialect.attributes_of(node), tuple(node.inputs)
    graph.outputs.clear()
    graph.insert_before(node, place)
    graph.remove(node)
    writer = FusedCall(place, opset=OPSETS[0], by=_PASS)
    # to the own form, its reference, and back
    own = dialect.inputs_to_own(writer, given, attributes)
    arrays = _evaluate(graph, present(own), inputs)
    result = operator.reference(arrays, dialect.options_to_own(attributes))
    answer = ir.val("answer", ir.DataType.DOUBLE, result.shape)
    graph.inputs.append(answer)
    converted = dialect.result_from_own(writer, answer, own)
    (array,) = _evaluate(graph, [converted], {**inputs, "answer": result})
    assert array is not None
    return array


def _evaluate(
    graph: ir.Graph, values: Sequence[ir.Value], inputs: Mapping[str, NdArray]
) -> list[NdArray | None]:
    """Compute values of a graph, of which some may be its inputs or constants."""
    computed = [value for value in values if value.producer()]
    graph.outputs[:] = computed
    model = ir.Model(graph, ir_version=9)
    import_domains(model)
    known = {**inputs, **run_once(model, inputs)} if computed else inputs
    return [
        known[str(value.name)] if value.name in known else array_of(value)
        for value in values
    ]


OPSETS = (13, 17, 20)
TOLERANCE = 1e-4  # allowed max|a-b| / max(1, max|b|) of float32 against float64
_PASS = "check-operator"


def check_operator(
    operator: Operator, draw: Draw | None = None, *, seed: int = 0, calls: int = 3
) -> None:
    """Check that an operator computes the same, in whatever dialect it is called.

    It passes :func:`check_form`, and has an own form called ``me2e`` in the domain of
    that name. For every dialect, at the opsets 13, 17 and 20 that its body is written
    in, on random inputs: the body, run in float32, is the float64 reference within
    1e-4; the output has the declared shape and type; and calls in the own form are
    translated into the dialect, unless that refuses them, and compute the same there.

    The operator need not be installed. ``draw`` makes a call in a dialect; None draws
    what the dialect's operands declare, and any shape if they declare none. So many
    ``calls`` are drawn for each dialect and opset.

    Raises:
        VerificationError: it broke a promise; the message says which.
        Me2eError: it refused a call in a dialect of its own.
    """
    # Its own form, the same for all operators
    check_form(operator, OPERATORS)
    name, own = operator.name, operator.own
    require(
        own.name == own.domain == OWN_DOMAIN,
        f"{name}: the own form is {own.name!r} in the domain {own.domain!r}, both must"
        f" be {OWN_DOMAIN!r}",
    )
    # sizes that nobody gives would count as unknown for ever
    sizes = {letter for operand in own.operands for letter in operand.letters}
    sizes |= {attribute.name for attribute in own.attributes}
    for which, text in (("output", operator.output), ("work", operator.work)):
        for word in text.split():
            require(
                word in sizes or word.isdigit(),
                f"{name}: {which} has {word!r}, which is no letter of an operand,"
                " attribute or number",
            )
    # Every dialect at every opset, on random calls
    make = draw_call if draw is None else draw
    for dialect in operator.all_dialects():
        random = np.random.default_rng(seed)
        for opset in (opset for opset in OPSETS if opset >= operator.opset):
            for _ in range(calls):
                case = _Case(operator, dialect, opset)
                case.check_call(make(dialect, random))
                case.check_translated(make(own, random))


@dataclasses.dataclass(frozen=True)
class _Case:
    """An operator in a dialect, in graphs of an opset."""

    operator: Operator
    dialect: Dialect
    opset: int

    def check_call(self, call: DrawnCall) -> None:
        """Compare the body and the declared shape of a call with its reference."""
        # what the dialect declares
        model = one_node_model(call, self.dialect, self.opset)
        node = model.graph[0]
        self.dialect.check(node)
        want = dialect_reference(self.operator, self.dialect, call)
        set_output(node, self.operator, self.dialect)
        shape, kind = node.outputs[0].shape, node.outputs[0].dtype
        declared = None if shape is None else list(shape)
        fits = declared is None or (
            len(declared) == want.ndim
            and all(
                dim == size or not isinstance(dim, int)
                for dim, size in zip(declared, want.shape, strict=True)
            )
        )
        self._require(
            fits, f"the output is said to be {declared}, it is {list(want.shape)}"
        )
        # what the body computes
        node.outputs[0].shape = node.outputs[0].type = None  # the body says it itself
        known = (self.operator, self.dialect)
        expand(node, opset=self.opset, by=_PASS, known=known)
        import_domains(model)
        result = run_once(model, call.inputs)["result"]
        same = kind in (None, ir.DataType.from_numpy(result.dtype))
        self._require(same, f"the output is said to be {kind}, it is {result.dtype}")
        self._compare("the body", result, want)

    def check_translated(self, call: DrawnCall) -> None:
        """Compare a call in the own form, translated, with its reference."""
        own = self.operator.own
        if self.dialect == own:
            return
        # a call in the own form, translated and expanded
        model = one_node_model(call, own, self.opset)
        before, after = (self.operator, own), (self.operator, self.dialect)
        try:
            translate(
                model.graph[0], self.dialect, opset=self.opset, by=_PASS, known=before
            )
            (node,) = (
                node for node in model.graph if node.op_type == self.dialect.op_type
            )
            expand(node, opset=self.opset, by=_PASS, known=after)
        except PreconditionError:
            return  # a dialect need not be able to say everything
        import_domains(model)
        result = run_once(model, call.inputs)["result"]
        self._compare(
            "a translated call", result, dialect_reference(self.operator, own, call)
        )

    def _compare(self, what: str, result: NdArray, want: NdArray) -> None:
        got, wanted = list(result.shape), list(want.shape)
        self._require(got == wanted, f"{what} gives {got}, the reference {wanted}")
        scale = max(1.0, float(np.abs(want).max(initial=0.0)))
        error = float(np.abs(result - want).max(initial=0.0)) / scale
        text = f"{what} is off the reference by {error:.2g}, of {TOLERANCE:g} allowed"
        self._require(error <= TOLERANCE, text)  # NaN is not

    def _require(self, holds: bool, why: str) -> None:
        call = f"{self.operator.name} in the dialect {self.dialect.name}, opset"
        require(holds, f"{call} {self.opset}: {why}")
