"""The TOML file that describes a stack of several ONNX files."""

import json
import re
from pathlib import Path
from typing import Any, Self

import pydantic

from me2e_compress.errors import FORMER, GraphError
from me2e_compress.registry import documents

_NAME = re.compile(r"[A-Za-z0-9_-]+")
_STRICT = pydantic.ConfigDict(frozen=True, extra="forbid")


class PartEntry(pydantic.BaseModel):
    """One ``[[part]]``.

    Attributes:
        name: letters, digits, ``_`` and ``-``.
        file: the ONNX file, relative to the TOML.
    """

    model_config = _STRICT

    name: str
    file: Path

    @pydantic.model_validator(mode="before")
    @classmethod
    def _without_first_frame(cls, value: Any) -> Any:
        if isinstance(value, dict) and "first_frame" in value:
            raise ValueError(FORMER["stack first_frame"])
        return value

    @pydantic.model_validator(mode="after")
    def _named(self) -> Self:
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

    @pydantic.field_validator("state", mode="before")
    @classmethod
    def _without_first(cls, state: Any) -> Any:
        if isinstance(state, dict) and any(isinstance(e, dict) for e in state.values()):
            raise ValueError(FORMER["stack first"])
        return state

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

    def said(self) -> dict[str, str]:
        """Return the metadata as texts."""
        return {
            key: value if isinstance(value, str) else json.dumps(value)
            for key, value in self.metadata.items()
        }
