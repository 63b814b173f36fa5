"""The TOML file that describes a stack of several ONNX files."""

import json
import re
from pathlib import Path
from typing import Annotated, Any, Self

import pydantic

from me2e_compress.errors import GraphError
from me2e_compress.registry import documents
from me2e_compress.registry.documents import toml_string

SUFFIX = ".toml"
"""Suffix of a file that describes a stack, wherever a model is expected."""


def is_stack(path: str | Path) -> bool:
    """Return whether a file name is that of a stack's TOML file."""
    return Path(path).suffix == SUFFIX


ZEROS = "zeros"
"""The default first value of a state."""

_NAME = re.compile(r"[A-Za-z0-9_-]+")
_STRICT = pydantic.ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class PartEntry(pydantic.BaseModel):
    """One ``[[part]]``.

    Attributes:
        name: letters, digits, ``_`` and ``-``.
        file: the ONNX file, relative to the TOML; without one, the part runs at first
            frames alone.
        first_frame: the ONNX file that runs instead where a scene begins.
    """

    model_config = _STRICT

    name: str
    file: Path | None = None
    first_frame: Path | None = None

    @pydantic.model_validator(mode="after")
    def _named(self) -> Self:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"name {self.name!r}: letters, digits, _ and - alone")
        if self.file is None and self.first_frame is None:
            raise ValueError(f"{self.name} has neither file nor first_frame")
        return self

    def files(self) -> tuple[tuple[str, Path], ...]:
        """Return its files by label: ``head`` and ``head.first_frame``."""
        named = ((self.name, self.file), (first_label(self.name), self.first_frame))
        return tuple((label, path) for label, path in named if path is not None)


class StateEntry(pydantic.BaseModel):
    """One entry of ``[state]``.

    Attributes:
        answer: the output that is fed back; in the file ``from``. None leaves it to
            the naming rules: ``X_out`` for ``X``, ``next_X`` for ``prev_X``.
        first: the value where a scene begins: ``zeros``, a file ``.npy`` or ``.npz``
            relative to the TOML, or ``PART.NAME``: an initializer of that part, or its
            output at that frame.
    """

    model_config = _STRICT

    answer: str | None = pydantic.Field(default=None, alias="from")
    first: str = ZEROS


def _entry(value: object) -> object:
    return {"from": value} if isinstance(value, str) else value


class StackFile(pydantic.BaseModel):
    """The content of the TOML file.

    Attributes:
        part: the parts, in any order.
        edges: ``{input: output}``, each ``PART.NAME`` or a name that one part alone
            has; equal names are joined automatically.
        state: what is fed back to each input; a text alone is the output.
        metadata: metadata that the ONNX files lack, such as ``me2e.plan``; values that
            are not text are written as JSON.
    """

    model_config = _STRICT

    part: tuple[PartEntry, ...] = pydantic.Field(min_length=1)
    edges: dict[str, str] = pydantic.Field(default_factory=dict)
    state: dict[str, Annotated[StateEntry, pydantic.BeforeValidator(_entry)]] = (
        pydantic.Field(default_factory=dict)
    )
    metadata: dict[str, Any] = pydantic.Field(default_factory=dict)

    @pydantic.field_validator("metadata")
    @classmethod
    def _as_json(cls, metadata: dict[str, Any]) -> dict[str, Any]:
        for key, value in metadata.items():
            try:
                json.dumps(value, allow_nan=False)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key}: {error}") from error
        return metadata

    @pydantic.model_validator(mode="after")
    def _once(self) -> Self:
        names = [each.name for each in self.part]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two parts are called {twice[0]}")
        return self

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file; GraphError if it cannot be read or has unknown entries."""
        with documents.reading(path, GraphError, "not a stack of several files"):
            return cls.model_validate(documents.from_toml(documents.content(path)))

    def text(self) -> str:
        """Return the content as TOML."""
        lines = list[str]()
        for each in self.part:
            lines += ["[[part]]", *_lines(each.model_dump(mode="json")), ""]
        for title, entries in (
            ("edges", self.edges),
            ("state", {name: _inline(each) for name, each in self.state.items()}),
            ("metadata", self.said()),
        ):
            if entries:
                lines += [f"[{title}]", *_lines(entries), ""]
        return "\n".join(lines)

    def said(self) -> dict[str, str]:
        """Return the metadata as texts."""
        return {
            key: value if isinstance(value, str) else json.dumps(value)
            for key, value in self.metadata.items()
        }


def first_label(part: str) -> str:
    """Return the label of the file that runs where a scene begins."""
    return f"{part}.first_frame"


class _Inline(str):
    """Ready-made TOML that is not quoted again."""

    __slots__ = ()


def _inline(entry: StateEntry) -> _Inline:
    said = {"from": entry.answer, "first": entry.first}
    return _Inline(f"{{{', '.join(_lines(said))}}}")


def _lines(entries: dict[str, Any]) -> list[str]:
    known = {key: value for key, value in entries.items() if value is not None}
    return [
        f"{key if _NAME.fullmatch(key) else toml_string(key)} ="
        f" {value if isinstance(value, _Inline) else toml_string(value)}"
        for key, value in known.items()
    ]
