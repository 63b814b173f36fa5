"""Results of commands: their printed form, and the document of `--json`."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from me2e_compress.base.display import Table
from me2e_compress.base.errors import Me2eError

# Version of the documents that `--json` prints; docs/json.md tells their keys. It grows
# where a key goes or changes its meaning, not where one is added.
SCHEMA = 3

Status = Literal["ok", "warning", "refused"]


@dataclasses.dataclass(frozen=True)
class View:
    """The printed form of a result: tables, then lines, then alerts in bold."""

    headline: str  # the result in one line
    tables: Iterable[Table] = ()
    # None are the headline alone; empty where the tables have everything
    lines: Iterable[str] | None = None
    alerts: Iterable[str] = ()
    error: Me2eError | None = None  # why the command ends with 1 though it has a result


class Result:
    """The result of a command: a dataclass of its data, printed by its `view`."""

    # Fields that JSON has, all by default; those of `*name` stand flat
    keys: ClassVar[tuple[str, ...]] = ()

    def view(self) -> View:
        """Return the printed form; by default the headline alone."""
        return View(self.headline)

    @property
    def headline(self) -> str:
        """The result in one line."""
        return self.view().headline

    def __repr__(self) -> str:
        """Show the class and the one line."""
        return f"<{type(self).__name__}: {self.headline}>"

    def tables(self) -> tuple[Table, ...]:
        """Return the tables, which are printed first."""
        return tuple(self.view().tables)

    def lines(self) -> tuple[str, ...]:
        """Return the lines below the tables."""
        lines = self.view().lines
        return (self.headline,) if lines is None else tuple(lines)

    def alerts(self) -> tuple[str, ...]:
        """Return the warnings, which are printed last."""
        return tuple(self.view().alerts)

    def check(self) -> None:
        """Raise the error of a result that is refused, if there is one."""
        if (error := self.view().error) is not None:
            raise error

    @property
    def status(self) -> Status:
        """``refused`` where the command's exit code is 1, ``warning`` with alerts."""
        if self.view().error is not None:
            return "refused"
        return "warning" if self.alerts() else "ok"

    def to_json(self) -> object:
        """Return all data, for `json_ready`: by default the fields that `keys` name."""
        content, own = dict[str, object](), _fields(self)
        for key in self.keys or own:
            name = key.removeprefix("*")
            content |= {name: own[name]} if name == key else json_ready(own[name])
        return content

    def document(self) -> dict[str, object]:
        """Return the ``--json`` document: version, status, printed lines, all data.

        Dataclasses and paths become objects and strings, numbers that are not finite
        null.
        """
        content = json_ready(self.to_json())
        if not isinstance(content, Mapping):
            raise TypeError(f"{type(self).__name__}.to_json: not an object")
        verdict = [*(self.lines() or (self.headline,)), *self.alerts()]
        return {"schema": SCHEMA, "status": self.status, "verdict": verdict, **content}


def _fields(value: Any) -> dict[str, object]:
    names = (field.name for field in dataclasses.fields(value))
    return {name: getattr(value, name) for name in names}


def json_ready(value: object) -> Any:
    """Turn objects, by their own `to_json` or their fields, into what JSON can hold.

    Paths become strings, NaN and infinities null.
    """
    if (own := getattr(value, "to_json", None)) is not None:
        return json_ready(own())
    if dataclasses.is_dataclass(value):
        return json_ready(_fields(value))
    if isinstance(value, Mapping):
        return {key: json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
