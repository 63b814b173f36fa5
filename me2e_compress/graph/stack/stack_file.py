"""The TOML file that names the ONNX files of a stack, and one file of it."""

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import onnx_ir as ir
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.files import is_beside, load
from me2e_compress.graph.recurrence import SessionPort, declared_pairs, port_of

_NAME = re.compile(r"[A-Za-z0-9_-]+")
_STRICT = pydantic.ConfigDict(frozen=True, extra="forbid")


class PartEntry(pydantic.BaseModel):
    """One ``[[part]]``: its name, and the ONNX file, relative to the TOML."""

    model_config = _STRICT

    name: str
    file: Path

    @pydantic.model_validator(mode="after")
    def _check_name(self) -> Self:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"name {self.name!r}: letters, digits, _ and - alone")
        return self


class StackFile(pydantic.BaseModel):
    """The content of the TOML file.

    Attributes:
        part: the parts, in any order.
        edges: ``{input: output}``, each ``PART.NAME`` or a name that one part alone
            has; equal names are joined automatically.
        state: ``{input: output}`` of what is fed back at the next frame, where names
            do not say it.
        metadata: metadata that the ONNX files lack, such as ``me2e.plan``; values that
            are not text are written as JSON.
    """

    model_config = _STRICT

    part: tuple[PartEntry, ...] = pydantic.Field(min_length=1)
    edges: dict[str, str] = pydantic.Field(default_factory=dict)
    state: dict[str, str] = pydantic.Field(default_factory=dict)
    metadata: dict[str, Any] = pydantic.Field(default_factory=dict)

    @pydantic.field_validator("metadata")
    @classmethod
    def _as_text(cls, metadata: dict[str, Any]) -> dict[str, str]:
        texts = dict[str, str]()
        for key, value in metadata.items():
            try:
                text = json.dumps(value, allow_nan=False)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key}: {error}") from error
            texts[key] = value if isinstance(value, str) else text
        return texts

    @pydantic.model_validator(mode="after")
    def _check_names(self) -> Self:
        names = [entry.name for entry in self.part]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two parts are called {twice[0]}")
        return self

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file; GraphError if it cannot be read or has unknown entries."""
        with documents.reading(path, GraphError, "not a stack of several files"):
            return cls.model_validate(documents.from_toml(documents.read_bytes(path)))


@dataclasses.dataclass(frozen=True)
class Part:
    """One ONNX file of a stack; ``file`` is its path as the TOML names it."""

    name: str
    file: Path
    path: Path
    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    model: ir.Model = dataclasses.field(repr=False)

    @classmethod
    def load(cls, entry: PartEntry, toml: Path) -> Self:
        """Read a file; GraphError if it is missing, no graph, or outside the folder."""
        path, file = toml.parent / entry.file, entry.file
        if file.is_absolute() or not is_beside(path, toml):
            raise GraphError(f"{file} is outside the folder of the stack: not read")
        model = load(path)
        inputs, outputs = (
            {str(value.name): port_of(value) for value in values}
            for values in (model.graph.inputs, model.graph.outputs)
        )
        return cls(entry.name, file, path, inputs, outputs, model)

    def recurrent(self) -> dict[str, str | None]:
        """Return the output declared for each input; None if it is not fed back."""
        try:
            declared = declared_pairs(self.model.metadata_props)
        except GraphError as error:
            raise GraphError(f"{self.path}: {error}") from error
        if declared == {}:
            return dict.fromkeys(self.inputs)
        return declared or {}
