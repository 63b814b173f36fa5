"""Read and write ONNX files: weights mapped, outputs atomic, sources untouched."""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import onnx
import onnx_ir as ir
import onnx_ir.passes.common as common
from google.protobuf.message import DecodeError

from me2e_compress.base import atomic
from me2e_compress.base.display import error_line, join_names
from me2e_compress.base.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import STANDARD, bodies, nodes_of
from me2e_compress.graph.opset import fit_runtime, note_change
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.summary import weight_bytes
from me2e_compress.graph.validity import PLAIN_INITIALIZERS_SINCE_IR, check_file

# Weights beyond this go to a data file: protobuf cannot hold 2 GiB in one message.
INLINE_LIMIT_BYTES = 1_900_000_000

_BLOCK_BYTES = 1 << 22

# How a protobuf message begins that names a file of external data
_LOCATION = b"\n\x08location"


def load(path: str | Path) -> ir.Model:
    """Read an ONNX file; large external weights stay on disk and are mapped when read.

    Inputs that have a value become constants, and a graph in an opset in which
    onnxruntime cannot run it is converted; :func:`~me2e_compress.graph.opset.read_as`
    says what changed.

    Raises:
        GraphError: no such file, not an ONNX model, cut short, or its data file is
            missing, shorter than the model says or not in the model's folder; or it
            is newer than onnxruntime and cannot be converted to an older opset.
    """
    path = Path(path)
    if not path.is_file():
        raise GraphError(f"{path}: no such file")
    if path.suffix == ".toml":
        raise GraphError(
            f"{path}: a stack of several files is joined first: me2e-compress join"
            f" {path} -o MODEL.onnx"
        )
    try:
        proto = onnx.load(path, format="protobuf", load_external_data=False)
    except DecodeError as error:
        raise GraphError(
            f"{path}: not an ONNX file, or cut short ({error_line(error)})"
        ) from error
    # Build the graph, its nodes in order
    proto.graph.name = proto.graph.name or "graph"  # ONNX's checker wants one
    try:
        in_order = check_file(proto)
        model = ir.serde.deserialize_model(proto)
        if not in_order:
            model.graph.sort()
            for function in model.functions.values():
                function.graph.sort()
        provenance.unpack(model)
    except GraphError as error:
        raise GraphError(f"{path}: {error}") from error
    except (ir.serde.SerdeError, ValueError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        line = f"not a valid ONNX graph ({error_line(cause)})"
        raise GraphError(f"{path}: {line}") from error
    # The standard domain, which may be called ai.onnx, becomes the empty name
    for body, _ in bodies(model):
        for domain in STANDARD[1:]:
            if domain in body.opset_imports:
                body.opset_imports.setdefault("", body.opset_imports.pop(domain))
        for node in body.all_nodes():
            node.domain = "" if node.domain in STANDARD else node.domain
    # Weights, then versions
    ir.external_data.set_base_dir(model.graph, path.parent)
    _read_external(model, path)
    fit_runtime(model, path)
    _freeze_defaults(model)
    model.ir_version = max(model.ir_version, PLAIN_INITIALIZERS_SINCE_IR)
    return model


def _freeze_defaults(model: ir.Model) -> None:
    """Make constants of inputs that have initializers, and note that in the model."""
    weights = model.graph.initializers
    # A recurrent input stays an input, and begins as zeros
    if any(value.is_initializer() for value in model.graph.inputs):
        for name in filter(weights.__contains__, recurrent_inputs(model)):
            state = weights.pop(name)
            if state.const_value is not None and state.const_value.numpy().any():
                note_change(model, f"state {name} held a value, and begins as zeros")
            state.const_value = None
    # Before IR version 4 every initializer had to be an input, and exporters may still
    # list them (`keep_initializers_as_inputs`)
    names = [str(value.name) for value in model.graph.inputs if value.is_initializer()]
    common.RemoveInitializersFromInputsPass()(model)
    if names and model.ir_version >= PLAIN_INITIALIZERS_SINCE_IR:
        change = f"{join_names(names)} held a value: no input any more, but a constant"
        way = "what is to stay one, take out of the initializers"
        note_change(model, f"{change}; {way}")


def save(model: ir.Model, path: str | Path, *, external: bool | None = None) -> None:
    """Write an ONNX file, all or nothing.

    Args:
        model: what to write; it stays as it is.
        path: the file; with external weights a ``<name>.data`` stands beside it, or a
            ``<name>.1.data`` where the model that is replaced has the other.
        external: weights in their own file; None decides: yes where some already
            are, or where they would not fit one protobuf message.

    Raises:
        GraphError: the folder does not exist, or a data file of the model itself
            stands where this one would go.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise GraphError(f"{path}: no such folder {path.parent}")
    # Data files of the model itself must not be written over
    stored = external_tensors(model)
    names, own = data_names(path), {os.path.realpath(tensor.path) for tensor in stored}
    for data in names:
        if os.path.realpath(data) in own:
            raise GraphError(f"{data}: holds the weights of the model being saved")
    # The model that is replaced names one data file, if any; the last may be old
    there = path.is_file()
    earlier = [n for n in names if there and file_contains(path, n.name.encode())][:1]
    data = next(name for name in names if name not in earlier)
    if external is None:
        external = bool(stored) or weight_bytes(model) > INLINE_LIMIT_BYTES
    with (
        atomic.naming_file(path),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".saving-") as folder,
    ):
        draft = Path(folder) / path.name
        with _named_producer(model), provenance.packed(model):
            whole = inlined(model) if stored and not external else model
            where = data.name if external else None
            ir.save(whole, draft, format="protobuf", external_data=where)
        # The earlier model keeps its weights until the new one stands in its place.
        draft_data = draft.with_name(data.name)
        if draft_data.exists():
            with draft_data.open("ab") as stream:
                stream.write(atomic.BYTES)
            atomic.put_in_place(draft_data, data)
        atomic.put_in_place(draft, path)
    for old in earlier:
        atomic.remove(old)


@contextlib.contextmanager
def _named_producer(model: ir.Model) -> Iterator[None]:
    """Name this toolkit as a model's producer while it is written."""
    before = model.producer_name, model.producer_version
    model.producer_name, model.producer_version = atomic.PRODUCER, None
    try:
        yield
    finally:
        model.producer_name, model.producer_version = before


def data_names(path: Path) -> tuple[Path, Path]:
    """Return where the weights of a model may lie; what it is written over has one."""
    return path.with_name(f"{path.name}.data"), path.with_name(f"{path.name}.1.data")


def file_bytes(path: Path) -> int:
    """Count the bytes of a model: the file and those with its weights."""
    return sum(file.stat().st_size for file in (path, *_external_files(path)))


def sha256_of(path: Path) -> str:
    """Hash a file, and with it the external data it names, as lower-case hex."""
    hasher = hashlib.sha256()
    for file in (path, *_external_files(path)):
        with file.open("rb") as stream:
            hashlib.file_digest(stream, lambda: hasher)
    return hasher.hexdigest()


def _external_files(path: Path) -> list[Path]:
    """List the data files that a model names, in the order of its weights."""
    # Parsing hundreds of MB takes as long as hashing them: look first.
    if not file_contains(path, _LOCATION):
        return []
    model = ir.load(path, format="protobuf")
    files = [data_file(path, tensor) for tensor in external_tensors(model)]
    return list(dict.fromkeys(files))


def file_contains(path: Path, *words: bytes) -> bool:
    """Return whether a file contains any of these bytes."""
    # Block by block: a mapped file would count as memory of this process
    tail = b""
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            window = tail + block
            if any(word in window for word in words):
                return True
            tail = window[-max(map(len, words)) :]
    return False


def inlined(model: ir.Model) -> ir.Model:
    """Return a copy whose weights are all in memory."""
    copy = model.clone()
    ir.external_data.load_to_model(copy)
    return copy


# Weights up to this size are read at once: shapes and axes are among them, and ONNX's
# checker would look for their file in the working directory
SMALL_BYTES = 1024


def external_tensors(model: ir.Model) -> list[ir.ExternalTensor]:
    """List the weights and attributes whose data lie in a file of their own."""
    tensors = [
        value.const_value
        for graph in model.graphs()
        for value in graph.initializers.values()
    ]
    for node in nodes_of(model):
        for attribute in node.attributes.values():
            tensors += _tensors_of(attribute)
    return [tensor for tensor in tensors if isinstance(tensor, ir.ExternalTensor)]


def _tensors_of(attribute: ir.Attr) -> Sequence[ir.TensorProtocol]:
    if attribute.type == ir.AttributeType.TENSOR and not attribute.is_ref():
        return (attribute.as_tensor(),)
    if attribute.type == ir.AttributeType.TENSORS and not attribute.is_ref():
        return attribute.as_tensors()
    return ()


def _read_external(model: ir.Model, path: Path) -> None:
    """Check the files of external weights; read those that must not stay on disk."""

    def read(tensor: ir.TensorProtocol) -> ir.TensorProtocol:
        if not isinstance(tensor, ir.ExternalTensor):
            return tensor
        try:
            array = _anchored(tensor, path).numpy().copy()
            return ir.tensor(array, dtype=tensor.dtype, name=tensor.name)
        except (ValueError, TypeError) as error:
            message = f"{path}: {tensor.name} cannot be read ({error})"
            raise GraphError(message) from error

    # Large initializers of the main graph stay, mapped from an absolute path
    for graph in model.graphs():
        for value in graph.initializers.values():
            tensor = value.const_value
            if isinstance(tensor, ir.ExternalTensor):
                is_mapped = graph is model.graph and tensor.nbytes > SMALL_BYTES
                value.const_value = (
                    _anchored(tensor, path) if is_mapped else read(tensor)
                )
    # Tensors of attributes are read
    for node in nodes_of(model):
        for name, attribute in list(node.attributes.items()):
            stored = _tensors_of(attribute)
            if not any(isinstance(tensor, ir.ExternalTensor) for tensor in stored):
                continue
            tensors = [read(tensor) for tensor in stored]
            if attribute.type == ir.AttributeType.TENSOR:
                node.attributes[name] = ir.AttrTensor(name, tensors[0])
            else:
                node.attributes[name] = ir.AttrTensors(name, tensors)


def is_beside(path: Path, file: Path) -> bool:
    """Return whether a path is in the folder of a file, or of what that links to."""
    homes = os.path.realpath(file.parent), Path(os.path.realpath(file)).parent
    return any(Path(os.path.realpath(path)).is_relative_to(home) for home in homes)


def data_file(model: Path, tensor: ir.ExternalTensor) -> Path:
    """Find the file with a tensor's data; a GraphError if it is outside the folder."""
    # The rule is onnxruntime's: a relative path, and a link must stay in the model's
    # folder, or lead to where the model itself is a link to (a hub's cache)
    location = str(tensor.location)
    if os.path.isabs(location) or not location or "\0" in location:
        raise GraphError(
            f"{model}: the data of {tensor.name} lie at {location!r}, which is not a"
            " path within the model's folder: not read"
        )
    resolved = Path(os.path.realpath(model.parent / location))
    if not is_beside(resolved, model):
        raise GraphError(
            f"{model}: the data of {tensor.name} lie at {location!r} = {resolved},"
            " outside the model's folder: not read"
        )
    return resolved


def _anchored(tensor: ir.ExternalTensor, path: Path) -> ir.ExternalTensor:
    """Return a tensor with an absolute path; check that its file holds it."""
    data = data_file(path, tensor)
    if not data.is_file():
        missing = path.parent / str(tensor.location)
        raise GraphError(f"{path}: its weights file {missing} is missing")
    # The file must hold what the model says, and be one that onnx reads
    status = data.stat()
    end = (tensor.offset or 0) + max(tensor.length or 0, tensor.nbytes)
    if status.st_size < end:
        raise GraphError(
            f"{path}: {data} is cut short: {tensor.name} ends at byte {end},"
            f" the file at {status.st_size}"
        )
    if status.st_nlink > 1:
        raise GraphError(
            f"{path}: the data of {tensor.name} lie in {data}, a file with"
            f" {status.st_nlink} hard links, which onnx refuses: copy it"
        )
    # The same tensor, anchored at the folder of the file that was checked
    return ir.ExternalTensor(
        data.name,
        tensor.offset,
        tensor.length,
        tensor.dtype,
        shape=ir.Shape(tensor.shape.numpy()),
        name=tensor.name,
        doc_string=tensor.doc_string,
        base_dir=data.parent,
    )
