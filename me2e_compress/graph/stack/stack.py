"""A stack of several ONNX files as one graph."""

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.recurrence import RECURRENT
from me2e_compress.graph.stack.joining import Joined, join
from me2e_compress.graph.stack.merge import merged
from me2e_compress.graph.stack.part_graph import PartGraph, form
from me2e_compress.graph.stack.split import split
from me2e_compress.graph.stack.stack_file import StackFile


@dataclasses.dataclass(frozen=True, eq=False)
class JoinedStack:
    """A stack of several files, joined into one graph.

    Attributes:
        files: the ONNX files by part, as the TOML names them.
        joined: what feeds what, and the names in the graph: an output is ``NAME``, or
            ``PART.NAME`` where two parts share it.
        model: the graph.
    """

    files: Mapping[str, Path]
    joined: Joined
    model: ir.Model

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file and the files it names, and join them.

        Raises:
            GraphError: a file is missing, no graph or outside the folder, or does not
                fit the others; the message names the TOML file, the part, the tensor.
        """
        content = StackFile.load(path)
        try:
            parts = [
                PartGraph.load(each.name, _inside(path, each.file))
                for each in content.part
            ]
            joined = join(content, parts)
            model = merged(joined.joints, joined.names, tuple(joined.inputs))
        except GraphError as error:
            raise GraphError(f"{path}: {error}") from error
        model.graph.name = path.stem
        model.metadata_props.update(joined.metadata)
        pairs = {name: joined.recurrent.get(name) for name in joined.inputs}
        model.metadata_props[RECURRENT] = json.dumps(pairs)
        return cls({each.name: each.file for each in content.part}, joined, model)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that were read."""
        return tuple(each.path for each in self.joined.joints.graphs.values())

    def feeds(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield part, input, source and form of what is fed, in the order of runs.

        A source is an output (``backbone.feats``), ``frames`` or ``state: OUTPUT``.
        """
        joints, recurrent = self.joined.joints, self.joined.recurrent
        for part in joints.order:
            for name, source in joints.sources[part].items():
                given = f"state: {recurrent.get(source.name)}"
                if source.part:
                    given = f"{source.part}.{source.name}"
                elif source.name not in recurrent:
                    given = "frames"
                yield part, name, given, form(joints.graphs[part].inputs[name])

    def split(self, model: ir.Model) -> dict[str, ir.Model]:
        """Cut a graph that was made of ``model`` into its parts."""
        joined = self.joined
        return split(model, joined.joints, joined.names, self.model.metadata_props)


def _inside(path: Path, named: Path) -> Path:
    """Return a file that a stack's TOML names, which must lie in its folder."""
    homes = {Path(os.path.realpath(path.parent)), Path(os.path.realpath(path)).parent}
    found = path.parent / named
    if named.is_absolute() or not any(
        Path(os.path.realpath(found)).is_relative_to(home) for home in homes
    ):
        raise GraphError(f"{named} is outside the folder of the stack: not read")
    return found
