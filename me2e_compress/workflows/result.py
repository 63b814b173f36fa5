"""Results of workflows: what is said of them, and the document of `--json`."""

import abc
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from me2e_compress.display import (
    AT_LEAST,
    Cell,
    Table,
    counted,
    duration,
    giga,
    megabytes,
    not_measured,
    number,
    significant,
    table,
)

__all__ = [
    "AT_LEAST",
    "SCHEMA",
    "Cell",
    "Result",
    "Status",
    "Table",
    "counted",
    "duration",
    "giga",
    "megabytes",
    "not_measured",
    "number",
    "plain",
    "significant",
    "table",
]


SCHEMA = 3
"""Version of the documents that ``--json`` prints; docs/json.md tells their keys. It
grows where a key goes or changes its meaning, not where one is added."""

Status = Literal["ok", "warning", "refused"]


class Result(abc.ABC):
    """The result of a workflow."""

    @property
    @abc.abstractmethod
    def headline(self) -> str:
        """What it is, in one line."""

    def __repr__(self) -> str:
        """Show the class and the one line."""
        return f"<{type(self).__name__}: {self.headline}>"

    def tables(self) -> tuple[Table, ...]:
        """Return no table where the lines say everything."""
        return ()

    def lines(self) -> tuple[str, ...]:
        """Return what is said below the tables."""
        return (self.headline,)

    def alerts(self) -> tuple[str, ...]:
        """Return what must not be overlooked: said last, in bold."""
        return ()

    def to_json(self) -> object:
        """Return everything, as JSON data: by default what the fields hold."""
        return plain(self)

    @property
    def status(self) -> Status:
        """What a program acts on: ``refused`` where the command's exit code is 1."""
        return "warning" if self.alerts() else "ok"

    def document(self) -> dict[str, object]:
        """Return the ``--json`` document: version, status, the lines said, everything.

        Dataclasses and paths become objects and strings, numbers that are not finite
        null.
        """
        found = plain(self.to_json())
        if not isinstance(found, Mapping):
            raise TypeError(f"{type(self).__name__}.to_json: not an object")
        said = [*(self.lines() or (self.headline,)), *self.alerts()]
        return {"schema": SCHEMA, "status": self.status, "verdict": said, **found}


def plain(value: object) -> object:
    """Turn dataclasses, paths, NaN and infinities into what JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
