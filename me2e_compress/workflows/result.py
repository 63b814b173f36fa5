"""Results that show themselves: on a terminal, in a notebook, to a program."""

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from me2e_compress.display import (
    AT_LEAST,
    MOST_ROWS,
    Cell,
    Displayed,
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
from me2e_compress.errors import MissingPackageError

__all__ = [
    "AT_LEAST",
    "MOST_ROWS",
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


SCHEMA = 2
"""Version of the documents that ``--json`` prints; docs/json.md tells their keys. It
grows where a key goes or changes its meaning, not where one is added."""

Status = Literal["ok", "warning", "refused"]


class Result(Displayed):
    """The result of a workflow."""

    def tables(self) -> tuple[Table, ...]:
        """Return no table where the lines say everything."""
        return ()

    @abc.abstractmethod
    def records(self) -> list[dict[str, object]]:
        """Return flat rows of one kind, to compute with."""

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

    def to_pandas(self) -> Any:
        """Build a ``pandas.DataFrame`` of the records; pandas must be installed."""
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingPackageError("pandas") from error
        return pd.DataFrame(self.records())

    def _repr_html_(self) -> str:
        """Show the tables in a notebook, or the records where there are none."""
        records = () if self.tables() else _table_of(self.records())
        return "".join(each.html() for each in records) + super()._repr_html_()


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


def _table_of(records: Sequence[Mapping[str, object]]) -> tuple[Table, ...]:
    if not records:
        return ()
    rows = [[str(value) for value in record.values()] for record in records]
    return (table("", list(records[0]), rows),)
