"""A stack of several ONNX files as one graph."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph import files as single
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.recurrence import RECURRENT, SessionPort, declared_pairs
from me2e_compress.graph.stack.joining import Joined, join
from me2e_compress.graph.stack.merge import merged
from me2e_compress.graph.stack.part_graph import PartGraph, form
from me2e_compress.graph.stack.split import split
from me2e_compress.graph.stack.stack_file import StackFile, is_stack
from me2e_compress.registry import marks

_ARRAYS = (".npy", ".npz")


@dataclasses.dataclass(frozen=True, eq=False)
class JoinedStack:
    """A stack of several files, joined into one graph.

    Attributes:
        path: path of the TOML file.
        files: the ONNX files by label: ``head``, ``head.first_frame``.
        model: the graph at every frame but, perhaps, the first of a scene.
        first: the graph at first frames; None where it is the same.
        outputs: those of every frame: ``NAME``, or ``PART.NAME`` where two share it.
        recurrent: ``{input: output}`` of the state that is fed forward.
        first_values: first values of recurrent inputs that are not zeros.
    """

    path: Path
    content: StackFile
    files: Mapping[str, PartGraph]
    joined: Joined
    model: ir.Model
    first: ir.Model | None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file and the files it names, and join them.

        Raises:
            GraphError: a file is missing, no graph or outside the folder, or does not
                fit the others; the message names the TOML file, the part, the tensor.
        """
        content = StackFile.load(path)
        try:
            files = {
                label: PartGraph.load(label, entry.name, _inside(path, file))
                for entry in content.part
                for label, file in entry.files()
            }
            for entry in content.state.values():
                if Path(entry.first).suffix in _ARRAYS:
                    _inside(path, Path(entry.first))
            joined = join(content, tuple(files.values()), path.parent)
            model = _merged(joined, path, first=False)
            first = _merged(joined, path, first=True) if _differs(joined) else None
        except GraphError as error:
            raise GraphError(f"{path}: {error}") from error
        return cls(path, content, files, joined, model, first)

    @property
    def outputs(self) -> Mapping[str, SessionPort]:
        """The outputs present at every frame."""
        return self.joined.outputs

    @property
    def recurrent(self) -> Mapping[str, str]:
        """``{input: output}`` of the state."""
        return self.joined.recurrent

    @property
    def first_values(self) -> Mapping[str, Array]:
        """First values that are not zeros."""
        return self.joined.first_values

    @property
    def first_files(self) -> Mapping[str, PartGraph]:
        """The files that run at first frames alone, by label."""
        kept = {each.label for each in self.joined.at_next.graphs.values()}
        return {name: each for name, each in self.files.items() if name not in kept}

    def fed(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield file, input, source and form of what is fed, in the order of runs.

        A source is an output (``backbone.feats``), ``frames`` or ``state: OUTPUT``.
        """
        for joints in (self.joined.at_first, self.joined.at_next):
            for part in joints.order:
                file = joints.graphs[part]
                for name, source in joints.sources[part].items():
                    given = f"state: {self.recurrent.get(source.name)}"
                    if source.part:
                        given = f"{source.part}.{source.name}"
                    elif source.name not in self.recurrent:
                        given = "frames"
                    yield file.label, name, given, form(file.inputs[name])

    def saying(self, said: Mapping[str, str]) -> dict[str, str]:
        """Return metadata that override its own; pairs of state are added to it."""
        pairs = declared_pairs(said)
        if not pairs:
            return dict(said)
        return {**said, RECURRENT: json.dumps({**self.recurrent, **pairs})}

    def save(self, model: ir.Model, path: Path) -> None:
        """Split a graph that passes made of ``model``; write its files beside a TOML.

        The folder must hold the files for first frames already: ``PART.first_frame
        .onnx``. First values are written as arrays.
        """
        parts = split(
            model, self.joined.at_next, self.joined.names, self.model.metadata_props
        )
        for part, each in parts.items():
            single.save(each, path.with_name(f"{part}.onnx"))
        inputs_taken = {
            (part, str(value.name))
            for part, each in parts.items()
            for value in each.graph.inputs
        }
        inputs_taken |= {
            (each.part, name)
            for each in self.first_files.values()
            for name in each.inputs
        }
        content = self._moved(path.parent, inputs_taken)
        path.write_text(f"{marks.IN_TOML}{content.text()}", "utf-8")

    def _moved(self, folder: Path, inputs_taken: Set[tuple[str, str]]) -> StackFile:
        """Return the content for files that stand beside it under the parts' names.

        What is said of inputs that no part has any more is left out.
        """
        alive = {part for part, _ in inputs_taken}
        parts = tuple(
            each.model_copy(
                update={
                    "file": each.file and Path(f"{each.name}.onnx"),
                    "first_frame": each.first_frame
                    and Path(f"{each.name}.first_frame.onnx"),
                }
            )
            for each in self.content.part
            if each.name in alive
        )
        edges = {
            text: output
            for text, output in self.content.edges.items()
            if inputs_taken & {*self.joined.names.inputs(text, "")}
        }
        state = {
            text: entry
            for text, entry in self.content.state.items()
            if inputs_taken & {*self.joined.names.inputs(text, "")}
        }
        for at, (name, entry) in enumerate(list(state.items())):
            value = self.first_values.get(name.partition(".")[2])
            value = self.first_values.get(name, value)
            if value is not None:
                file = folder / f"first_value_{at}.npy"
                with file.open("wb") as stream:
                    np.save(stream, value, allow_pickle=False)
                    stream.write(marks.BYTES)
                state[name] = entry.model_copy(update={"first": file.name})
        return self.content.model_copy(
            update={"part": parts, "edges": edges, "state": state}
        )


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedModel:
    """A graph in memory, its path, and the stack that it was joined from, if any."""

    path: Path
    model: ir.Model
    stack: JoinedStack | None = None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read an ONNX file, or the files that a stack's TOML names as one graph.

        See :func:`me2e_compress.graph.files.load` and :class:`JoinedStack`.
        """
        if is_stack(path) and path.is_file():
            stack = JoinedStack.load(path)
            return cls(path, stack.model, stack)
        return cls(path, single.load(path))

    @property
    def file(self) -> Path | None:
        """The file that holds this very graph; None of a stack."""
        return self.path if self.stack is None else None

    @property
    def first_files(self) -> Mapping[str, PartGraph]:
        """The files of a stack that run at first frames alone, by label."""
        return {} if self.stack is None else self.stack.first_files

    def save(self, model: ir.Model, path: Path) -> None:
        """Write a graph that passes made of this one, in as many files."""
        if self.stack is None:
            single.save(model, path)
        else:
            self.stack.save(model, path)


def load(path: str | Path) -> ir.Model:
    """Read an ONNX file or a stack as one graph; see :class:`LoadedModel`."""
    return LoadedModel.load(Path(path)).model


def paths_of(path: Path) -> tuple[Path, ...]:
    """Return the files of a model: of a stack, TOML, graphs and first values.

    External weights are not among them.
    """
    if not is_stack(path):
        return (path,)
    content = StackFile.load(path)
    graphs = (file for entry in content.part for _, file in entry.files())
    values = (Path(each.first) for each in content.state.values())
    arrays = (each for each in values if each.suffix in _ARRAYS)
    return (path, *(path.parent / each for each in (*graphs, *arrays)))


def sha256_of(path: Path) -> str:
    """Hash a file, with its external data or, of a stack, with all its files."""
    if not is_stack(path):
        return single.sha256_of(path)
    digest = hashlib.sha256()
    for each in paths_of(path):
        digest.update(single.sha256_of(each).encode())
    return digest.hexdigest()


def file_bytes(path: Path) -> int:
    """Count the bytes of a model: its files, and those with its weights."""
    return sum(map(single.file_bytes, paths_of(path)))


def _merged(joined: Joined, path: Path, *, first: bool) -> ir.Model:
    joints = joined.at_first if first else joined.at_next
    model = merged(joints, joined.names, tuple(joined.inputs))
    model.graph.name = path.stem
    # an input that first frames alone take is one of the whole nevertheless
    known = {value.name for value in model.graph.inputs}
    if not first:
        model.graph.inputs.extend(
            _value(name, port)
            for name, port in joined.inputs.items()
            if name not in known
        )
    back = {
        str(value.name): joined.recurrent.get(str(value.name))
        for value in model.graph.inputs
    }
    model.metadata_props.update(joined.metadata)
    model.metadata_props[RECURRENT] = json.dumps(back)
    return model


def _differs(joined: Joined) -> bool:
    """Return whether other files, or other edges, hold at first frames."""
    first, other = joined.at_first, joined.at_next
    labels = [[each.label for each in side.graphs.values()] for side in (first, other)]
    return labels[0] != labels[1] or first.sources != other.sources


def _inside(path: Path, named: Path) -> Path:
    """Return a file that a stack's TOML names, which must lie in its folder."""
    homes = {Path(os.path.realpath(path.parent)), Path(os.path.realpath(path)).parent}
    found = path.parent / named
    if named.is_absolute() or not any(
        Path(os.path.realpath(found)).is_relative_to(home) for home in homes
    ):
        raise GraphError(f"{named} is outside the folder of the stack: not read")
    return found


def _value(name: str, port: SessionPort) -> ir.Value:
    element = port.type.removeprefix("tensor(").removesuffix(")").upper()
    known = ir.TensorType(ir.DataType[element]) if element in _ELEMENTS else None
    shape = ir.Shape(port.shape) if port.shape else None
    return ir.Value(name=name, type=known, shape=shape)


_ELEMENTS = frozenset(each.name for each in ir.DataType)
