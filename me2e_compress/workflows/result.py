"""Results that show themselves: on a terminal, in a notebook, to a program."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
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
    "significant",
    "table",
]


SCHEMA = 1
"""Version of the documents that ``--json`` prints; docs/json.md tells their keys. It
grows where a key goes or changes its meaning, not where one is added."""

Status = Literal["ok", "warning", "refused"]


class Result(Displayed):
    """The result of a workflow."""

    @abc.abstractmethod
    def records(self) -> list[dict[str, object]]:
        """Return flat rows of one kind, to compute with."""

    @abc.abstractmethod
    def to_json(self) -> object:
        """Return everything, as JSON data."""

    @property
    def status(self) -> Status:
        """What a program acts on: ``refused`` where the command's exit code is 1."""
        return "warning" if self.alerts() else "ok"

    def document(self) -> dict[str, object]:
        """Return the ``--json`` document: version, status, the lines said, everything.

        Values may be dataclasses, paths and numbers that are not finite, which JSON
        writes as objects, strings and null.
        """
        found = self.to_json()
        if dataclasses.is_dataclass(found) and not isinstance(found, type):
            found = dataclasses.asdict(found)
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


def _table_of(records: Sequence[Mapping[str, object]]) -> tuple[Table, ...]:
    if not records:
        return ()
    rows = [[str(value) for value in record.values()] for record in records]
    return (table("", list(records[0]), rows),)
