"""Checks of what users give, before any work: files, folders, models, numbers."""

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import FORMER, GraphError, RecipeError
from me2e_compress.graph.modules import ModuleMap, map_of
from me2e_compress.graph.opset import lowered
from me2e_compress.graph.shapes import unshaped_plugins
from me2e_compress.shipped.drivers import SHIPPED, shipped
from me2e_compress.workflows.listener import Listener

LARGEST = 1e15
"""The largest number of an option: beyond, milliseconds are no whole microseconds."""
MOST_THREADS = 1024
"""Most threads of a session: onnxruntime starts all of them, beyond the cores too."""

Given: TypeAlias = str | Path | None
"""An input as the user names it; a word that does not name a file is harmless."""


_MOST_DIGITS = 18
"""Most digits of a dimension's size, which must fit into a 64-bit integer."""


def model_path(text: str | Path, beside: Path = Path()) -> Path:
    """Return the file that a path or a shipped name means; an existing file wins."""
    path = beside / text
    if path.is_file():
        return path
    if str(text) in SHIPPED:
        return shipped(str(text))
    line = f"{text}: no such file; models that ship: {', '.join(SHIPPED)}"
    gone = FORMER.get(f"model {text}", FORMER.get(f"stack {text}", line))
    raise GraphError(gone)


def read_graph(
    path: Path, listener: Listener, adapter: Given = None, module_map: Given = None
) -> ir.Model:
    """Read a graph; warn of a lowered opset and of missing shapes.

    What an adapter and a map state becomes metadata of the graph; see :func:`adapted`.
    """
    model = graph.load(path)
    adapted(model, adapter, module_map)
    if said := lowered(model):
        listener.on_warning(f"{path}: {said}: onnxruntime reads no newer")
    if lack := lacking_shapes(model):
        listener.on_warning(f"{path}: {lack}")
    return model


def lacking_shapes(model: ir.Model) -> str:
    """Describe the plugins whose output shapes are unknown; empty if there are none."""
    if not unshaped_plugins(model):
        return ""
    copy = model.clone()
    graph.infer_shapes(copy)  # plugins of known dialects tell it themselves
    plugins = unshaped_plugins(copy)
    if not plugins:
        return ""
    names = ", ".join(dict.fromkeys(node.op_type for node in plugins))
    return (
        f"{len(plugins)} plugin nodes ({names}) tell no shape of what they give; write"
        " it as value_info of the file, and folding, MACs and int8 go on behind them"
    )


def load_map(named: str | Path | None, model: ir.Model) -> ModuleMap:
    """Load the named module map; None finds the preset that fits the graph."""
    return map_of(model, None if named is None else str(named))


def output_path(named: str | Path) -> Path:
    """Return the path of an output, which must name a file."""
    path = Path(named)
    if path.name in ("", ".."):
        raise GraphError(f"{path} is a folder: name a file for the output")
    return path


def check_output(outputs: Sequence[Path | None], inputs: Iterable[Given]) -> None:
    """Refuse outputs that could not be written, or would harm an input.

    `inputs` are files and folders of frames that are read; the external weights of a
    model are protected as well.

    Raises:
        GraphError: An output is an input, a frame of a recording, a folder or a device,
            is named twice, or its folder does not exist.
    """
    named = dict[Path, Path]()
    # a model may be named by many variants, and is loaded to find its weights
    read = dict.fromkeys(Path(each) for each in inputs if each is not None)
    # an output must be a regular file in an existing folder, and named once
    for output in filter(None, outputs):
        if not output.parent.is_dir():
            raise GraphError(f"{output}: no such folder {output.parent}")
        if output.is_dir():
            raise GraphError(f"{output} is a folder: name a file for the output")
        if output.exists() and not output.is_file():
            raise GraphError(f"{output} is a device or a pipe: name a file")
        if named.setdefault(resolved(output), output) is not output:
            raise GraphError(f"{output} is named for two outputs: choose another name")
        # no input may be overwritten
        for given in read:
            _keep(output, given)


def check_folder(
    folder: Path, inputs: Iterable[Given], files: Sequence[str] = ()
) -> None:
    """Refuse a folder that could not be made, or whose `files` would harm an input."""
    read = list(inputs)
    if not resolved(folder).name:
        raise GraphError(f"{folder} is the root of all files: name a folder")
    if folder.exists() and not folder.is_dir():
        raise GraphError(f"{folder} is a file: name a folder for the output")
    if not folder.is_dir():
        return
    for given in (Path(each) for each in read if each is not None):
        if given.is_dir() and folder.samefile(given):
            raise GraphError(f"{folder} is the input: choose another folder")
    check_output([folder / name for name in files], read)


def resolved(path: Path) -> Path:
    """Resolve symbolic links; a path in a circle of links stays as it is."""
    return Path(os.path.realpath(path))


def _keep(output: Path, given: Path) -> None:
    """Refuse an output that would change an input."""
    if given.is_dir():
        inside = resolved(output).parent == resolved(given)
        if inside and (output.suffix == ".npz" or output.name == "scenes.json"):
            raise GraphError(
                f"{output} would be a frame of the input: choose another name"
            )
    elif output.exists() and given.is_file():
        if output.samefile(given):
            raise GraphError(
                f"{output} is the input: choose another name for the output"
            )
        if any(output.samefile(file) for file in _weights(given)):
            raise GraphError(f"{output} holds the weights of {given}: not written")


def _weights(given: Path) -> Iterator[Path]:
    """Yield the external weight files of a model; none for other files."""
    try:
        model = graph.load(given)
    except GraphError:  # not a model, or refused before anything is written
        return
    for each in model.graphs():
        for value in each.initializers.values():
            if isinstance(value.const_value, ir.ExternalTensor):
                yield Path(value.const_value.path)


def check_number(
    option: str, value: float | None, *, zero: bool = False, most: float = LARGEST
) -> None:
    """Refuse anything but None, a finite number above 0, or 0 if `zero` is set."""
    if value is None or 0 < value <= most or (zero and value == 0):
        return
    least = "0 or above" if zero else "above 0"
    above = f", {most:g} at most" if math.isfinite(value) and value > 0 else ""
    raise RecipeError(
        f"{option} is {value:g}: it must be a finite number {least}{above}"
    )


def check_count(option: str, value: int, most: int | None = None) -> None:
    """Refuse a count below 0, or above `most` unless that is None."""
    if value < 0:
        raise RecipeError(f"{option} is {value}: it must be 0 or more")
    if most is not None and value > most:
        raise RecipeError(f"{option} is {value}: it must be {most:,} at most")


def sizes(texts: Iterable[str]) -> dict[str, int]:
    """Parse sizes of open dimensions, such as ``batch=1`` or ``image:0=1``."""
    found: dict[str, int] = {}
    for text in texts:
        name, _, size = text.rpartition("=")
        if not name or not size.isdecimal() or len(size) > _MOST_DIGITS:
            raise RecipeError(f"--set-dim is {text!r}: write NAME=SIZE, e.g. batch=1")
        if name in found:
            raise RecipeError(f"--set-dim gives {name} twice")
        found[name] = int(size)
    return found
