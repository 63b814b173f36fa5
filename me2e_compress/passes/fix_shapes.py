"""Give open dimensions a size, so that shapes can be folded."""

import dataclasses
import json
from collections.abc import Mapping, Sequence

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.passes.base import Context, Pass, PassResult

# Metadata key of the sizes given to open dimensions, as JSON.
FIXED = "me2e.fixed"


@dataclasses.dataclass(frozen=True)
class FixShapes(Pass):
    """Give open dimensions of the inputs a size, and infer shapes from them.

    Given:   image float[batch,3,224,224]  ->  Shape, Gather, ... -> y float[batch,10]
    Result:  image float[1,3,224,224]  ->  Shape, Gather, ... -> y float[1,10]
             with dims={batch=1}

    Attributes:
        dims: size by the name of the dimension, or by input and axis where it has no
            name (``?``): ``{batch=1, "image:2"=224}``.

    Raises:
        RecipeError: a size is below 1, or none is given.
    """

    name = "fix-shapes"
    exact = True
    changes_interface = True
    dims: Mapping[str, int]

    def __post_init__(self) -> None:
        """Check the sizes."""
        if not self.dims:
            raise RecipeError(f"{self.name} needs sizes: dims={{batch=1}}")
        for name, size in self.dims.items():
            if size < 1:
                raise RecipeError(f"{self.name}: {name}={size} must be 1 or more")

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Write the sizes wherever the dimensions occur, then infer shapes."""
        # Sizes that an earlier run wrote need no change
        known = json.loads(model.metadata_props.get(FIXED, "{}"))
        wanted = {k: size for k, size in self.dims.items() if known.get(k) != size}
        if not wanted:
            return PassResult(model, 0)
        there = open_dimensions(model)
        if unknown := [name for name in wanted if name not in there]:
            raise PreconditionError(
                f"{self.name}: no open dimension is called {unknown[0]!r}; there is"
                f" {', '.join(there) or 'none'}"
            )
        # Blame the sizes only if the graph was sound before
        sound = _refusal(model) is None
        # Write the sizes in values of nodes, inputs of bodies, and inputs
        made = (value for node in model.graph.all_nodes() for value in node.outputs)
        stated = {value: value.shape for value in made}
        for value, shape in stated.items():
            value.shape = _sized(shape, wanted, "")
        for body in model.graph.subgraphs():
            for value in body.inputs:
                value.shape = _sized(value.shape, wanted, "")
        count = 0
        for value in model.graph.inputs:
            before = value.shape
            value.shape = _sized(before, wanted, str(value.name))
            count += value.shape is not before
        if (reason := _refusal(model)) is not None:
            # what a file says of an output may be wrong, and runtimes take it
            for value, shape in stated.items():
                if value.shape is not shape:
                    value.shape = None
            reason = _refusal(model)
        if sound and reason is not None:
            sizes = ", ".join(f"{name}={size}" for name, size in wanted.items())
            raise PreconditionError(f"{self.name}: the graph refuses {sizes}: {reason}")
        graph.infer_shapes(model)  # of a graph that ONNX never inferred strictly
        for value, shape in stated.items():
            if value.is_graph_output() and value.shape is None and shape is not None:
                value.shape = ir.Shape([None] * len(shape))
        model.metadata_props[FIXED] = json.dumps({**known, **wanted}, sort_keys=True)
        return PassResult(model, count)


def open_dimensions(model: ir.Model) -> dict[str, int]:
    """Map the open dimensions of inputs, by symbol or ``input:axis``, to their axis.

    A symbol that occurs at several axes maps to the first of them.
    """
    names: dict[str, int] = {}
    for value in model.graph.inputs:
        for axis, dim in enumerate(value.shape or ()):
            if isinstance(dim, ir.SymbolicDim):
                for name in _symbols(dim) or (f"{value.name}:{axis}",):
                    names[name] = min(axis, names.get(name, axis))
    return names


def sized_inputs(model: ir.Model, sizes: Mapping[str, int]) -> ir.Model:
    """Return a graph of only the inputs of another, with open dimensions sized."""
    inputs = [
        ir.Value(name=v.name, type=v.type, shape=_sized(v.shape, sizes, f"{v.name}"))
        for v in model.graph.inputs
    ]
    return ir.Model(ir.Graph(inputs, [], nodes=[]), ir_version=model.ir_version)


def with_sizes(passes: Sequence[Pass], dims: Mapping[str, int]) -> tuple[Pass, ...]:
    """Put FixShapes before the passes, but after a leading import-normalize."""
    if not dims:
        return tuple(passes)
    at = int(bool(passes) and passes[0].name == "import-normalize")
    return (*passes[:at], FixShapes(dims), *passes[at:])


def _symbols(dim: ir.SymbolicDim) -> tuple[str, ...]:
    """Return the symbols of a dimension: ``s0`` for ``2*s0 + 1``, none for ``?``."""
    if dim.value is None or not any(map(str.isalnum, dim.value)):
        return ()
    try:
        return tuple(sorted(dim.free_symbols()))
    except ValueError:  # a name that is no expression
        return (dim.value,)


def _sized(
    shape: ir.Shape | None, sizes: Mapping[str, int], owner: str
) -> ir.Shape | None:
    """Return a shape with symbols replaced by sizes; the same object if unchanged."""
    if shape is None:
        return None
    # A dimension has no name, a name, or is an expression of names
    dims: list[int | ir.SymbolicDim] = []
    for axis, dim in enumerate(shape):
        size: object = dim
        if isinstance(dim, ir.SymbolicDim) and not _symbols(dim):
            size = sizes.get(f"{owner}:{axis}", dim)
        elif isinstance(dim, ir.SymbolicDim) and dim.value in sizes:
            size = sizes[str(dim.value)]
        elif isinstance(dim, ir.SymbolicDim):  # an expression such as 2*s0 + 1
            known = {name: sizes[name] for name in _symbols(dim) if name in sizes}
            size = dim.evaluate(known) if known else dim
        dims.append(size if isinstance(size, int) else dim)
    same = all(a is b for a, b in zip(dims, shape, strict=True))
    return shape if same else ir.Shape(dims)


def _refusal(model: ir.Model) -> str | None:
    try:
        graph.infer_shapes(model, strict=True)
    except onnx.shape_inference.InferenceError as error:
        return " ".join(str(error).split())[:200]
    return None
