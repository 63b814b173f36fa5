"""Read and write ONNX files: weights mapped, outputs atomic, sources untouched."""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import onnx
import onnx_ir as ir
import onnx_ir.passes.common as common
from google.protobuf.message import DecodeError

from me2e_compress.display import reason
from me2e_compress.errors import GraphError
from me2e_compress.graph import structure
from me2e_compress.graph.opset import lower
from me2e_compress.graph.summary import weight_bytes
from me2e_compress.graph.validity import PLAIN_INITIALIZERS_SINCE_IR
from me2e_compress.graph.weight_files import (
    data_file,
    external_tensors,
    settle,
    write_inline,
)
from me2e_compress.registry import drafts

INLINE_LIMIT_BYTES = 1_900_000_000
"""Weights beyond this go to a data file: protobuf cannot hold 2 GiB in one message."""

_BLOCK_BYTES = 1 << 22

_LOCATION = b"\n\x08location"
"""How a protobuf message begins that names a file of external data."""


def load(path: str | Path) -> ir.Model:
    """Read an ONNX file; large external weights stay on disk and are mapped when read.

    Initializers that the exporter also listed as inputs
    (``keep_initializers_as_inputs``) stop being inputs, which is valid from IR version
    4 on: older models are raised to that. Newer ones than onnxruntime reads are
    written down to what it does (:func:`~me2e_compress.graph.opset.lowered` says so).

    Raises:
        GraphError: no such file, not an ONNX model, cut short, or its data file is
            missing, shorter than the model says or not in the model's folder; or it
            is newer than onnxruntime and cannot be written as an older one.
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
            f"{path}: not an ONNX file, or cut short ({reason(error)})"
        ) from error
    try:
        in_order = structure.check(proto)
        model = _built(proto, in_order)
    except GraphError as error:
        raise GraphError(f"{path}: {error}") from error
    ir.external_data.set_base_dir(model.graph, path.parent)
    settle(model, path)
    lower(model, path)
    common.RemoveInitializersFromInputsPass()(model)
    model.ir_version = max(model.ir_version, PLAIN_INITIALIZERS_SINCE_IR)
    return model


def _built(proto: onnx.ModelProto, in_order: bool) -> ir.Model:
    """Build the graph of a message, its nodes in order."""
    proto.graph.name = proto.graph.name or "graph"  # ONNX's checker wants one
    try:
        model = ir.serde.deserialize_model(proto)
        if not in_order:
            model.graph.sort()
            for function in model.functions.values():
                function.graph.sort()
    except (ir.serde.SerdeError, ValueError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise GraphError(f"not a valid ONNX graph ({reason(cause)})") from error
    return model


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
    stored = list(external_tensors(model))
    names, own = data_names(path), {os.path.realpath(each.path) for each in stored}
    for data in names:
        if os.path.realpath(data) in own:
            raise GraphError(f"{data}: holds the weights of the model being saved")
    # The model that is replaced names one data file, if any; the last may be old
    there = path.is_file()
    earlier = [each for each in names if there and _holds(path, each.name.encode())][:1]
    data = next(each for each in names if each not in earlier)
    if external is None:
        external = bool(stored) or weight_bytes(model) > INLINE_LIMIT_BYTES
    with (
        drafts.naming(path),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".saving-") as folder,
    ):
        draft = Path(folder) / path.name
        with _ours(model):
            if external:
                ir.save(model, draft, format="protobuf", external_data=data.name)
            else:
                write_inline(_inlined(model), draft)
        # The earlier model keeps its weights until the new one stands in its place.
        draft_data = draft.with_name(data.name)
        if draft_data.exists():
            with draft_data.open("ab") as stream:
                stream.write(drafts.BYTES)
            drafts.put(draft_data, data)
        drafts.put(draft, path)
    for old in earlier:
        drafts.remove(old)


@contextlib.contextmanager
def _ours(model: ir.Model) -> Iterator[None]:
    """Let a model name us as its producer while it is written."""
    before = model.producer_name, model.producer_version
    model.producer_name, model.producer_version = drafts.PRODUCER, None
    try:
        yield
    finally:
        model.producer_name, model.producer_version = before


def data_names(path: Path) -> tuple[Path, Path]:
    """Return where the weights of a model may lie; what it is written over has one."""
    return path.with_name(f"{path.name}.data"), path.with_name(f"{path.name}.1.data")


def is_external(model: ir.Model) -> bool:
    """Return whether some of the weights lie in a file of their own."""
    return any(True for _ in external_tensors(model))


def file_bytes(path: Path) -> int:
    """Count the bytes of a model: the file and those with its weights."""
    return sum(file.stat().st_size for file in (path, *_external_files(path)))


def sha256_of(path: Path) -> str:
    """Hash a file, and with it the external data it names, as lower-case hex."""
    hasher = hashlib.sha256()
    if _holds(path, _LOCATION, hasher):
        for file in _external_files(path):
            for block in _blocks(file):
                hasher.update(block)
    return hasher.hexdigest()


def _external_files(path: Path) -> list[Path]:
    """List the data files that a model names, in the order of its weights."""
    # Parsing hundreds of MB takes as long as hashing them: look first.
    if not _holds(path, _LOCATION):
        return []
    model = ir.load(path, format="protobuf")
    found = [data_file(path, tensor) for tensor in external_tensors(model)]
    return list(dict.fromkeys(found))


def _holds(path: Path, words: bytes, hasher: "hashlib._Hash | None" = None) -> bool:
    """Return whether a file holds some bytes; hash it on the way.

    It is read block by block: a mapped file would count as memory of this process.
    """
    found, tail = False, b""
    for block in _blocks(path):
        if hasher is not None:
            hasher.update(block)
        seen = tail + block
        found, tail = found or words in seen, seen[-len(words) :]
        if found and hasher is None:
            break
    return found


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            yield block


def _inlined(model: ir.Model) -> ir.Model:
    if not is_external(model):
        return model
    copy = model.clone()
    for graph in copy.graphs():
        for value in graph.initializers.values():
            tensor = value.const_value
            if isinstance(tensor, ir.ExternalTensor):
                value.const_value = ir.tensor(tensor.numpy(), name=value.name)
    return copy
