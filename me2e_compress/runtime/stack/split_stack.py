"""A stack of several ONNX files, joined and checked."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.recurrence import RECURRENT, SessionPort, declared_pairs
from me2e_compress.runtime.stack.joining import join
from me2e_compress.runtime.stack.joints import Joints
from me2e_compress.runtime.stack.part_graph import PartGraph
from me2e_compress.runtime.stack.stack_file import SUFFIX, StackFile


@dataclasses.dataclass(frozen=True, eq=False)
class SplitStack:
    """A stack of several files as one model.

    Attributes:
        path: path of the TOML file.
        files: the ONNX files by label: ``head``, ``head.first_frame``.
        inputs: the inputs by name, including the state.
        outputs: the outputs present at every frame, by name: ``NAME``, or ``PART.NAME``
            where two parts share a name.
        answers: part and output behind each of these names.
        recurrent: ``{input: output}`` of the state that is fed forward.
        first_values: first values of recurrent inputs that are not zeros.
        metadata: metadata of all files and of the TOML file, which wins.
    """

    path: Path
    content: StackFile
    files: Mapping[str, PartGraph]
    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    answers: Mapping[str, tuple[str, str]]
    recurrent: Mapping[str, str]
    first_values: Mapping[str, Array]
    at_first: Joints
    at_next: Joints
    metadata: Mapping[str, str]

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file and the files it names, and join them.

        Raises:
            GraphError: a file is missing or no graph, or the files do not fit each
                other; the message names the TOML file, the part and the tensor.
        """
        content = StackFile.load(path)
        try:
            files = {
                label: PartGraph.load(label, entry.name, path.parent / file)
                for entry in content.part
                for label, file in entry.files()
            }
            # Join the files; messages begin with the TOML file.
            joined = join(content, tuple(files.values()), path.parent)
        except GraphError as error:
            raise GraphError(f"{path}: {error}") from error
        return cls(
            path,
            content,
            files,
            joined.inputs,
            joined.outputs,
            joined.answers,
            joined.recurrent,
            joined.first_values,
            joined.at_first,
            joined.at_next,
            joined.metadata,
        )

    def saying(self, said: Mapping[str, str]) -> Self:
        """Return the stack with metadata that override its own."""
        pairs = {**self.recurrent, **(declared_pairs(said) or {})}
        recurrent = {name: to for name, to in pairs.items() if to is not None}
        metadata = {**self.metadata, **said}
        return dataclasses.replace(self, recurrent=recurrent, metadata=metadata)

    def paths(self) -> tuple[Path, ...]:
        """Return every file that belongs to it: the TOML file, graphs, first values."""
        named = (self.path.parent / each.first for each in self.content.state.values())
        return (
            self.path,
            *(each.path for each in self.files.values()),
            *(each for each in named if each.suffix in (".npy", ".npz")),
        )

    def sha256(self) -> str:
        """Return a digest of the content of all its files."""
        seal = hashlib.sha256()
        for each in self.paths():
            seal.update(graph.sha256_of(each).encode())
        return seal.hexdigest()

    def interface(self) -> ir.Model:
        """Return its inputs, outputs and metadata as a graph without nodes."""
        back = {name: self.recurrent.get(name) for name in self.inputs}
        model = ir.Model(
            ir.Graph(
                [_value(name, port) for name, port in self.inputs.items()],
                [_value(name, port) for name, port in self.outputs.items()],
                nodes=(),
                name=self.path.stem,
            ),
            ir_version=9,
        )
        model.metadata_props.update(self.metadata)
        model.metadata_props[RECURRENT] = json.dumps(back)
        return model


def is_stack(path: str | Path) -> bool:
    """Return whether a file name is that of a stack's TOML file."""
    return Path(path).suffix == SUFFIX


def digest_of_files(path: Path) -> str:
    """Return the SHA-256 of an ONNX file with its weights, or of a whole stack."""
    return SplitStack.load(path).sha256() if is_stack(path) else graph.sha256_of(path)


def _value(name: str, port: SessionPort) -> ir.Value:
    element = port.type.removeprefix("tensor(").removesuffix(")").upper()
    known = ir.TensorType(ir.DataType[element]) if element in _ELEMENTS else None
    shape = ir.Shape(port.shape) if port.shape else None
    return ir.Value(name=name, type=known, shape=shape)


_ELEMENTS = frozenset(each.name for each in ir.DataType)
