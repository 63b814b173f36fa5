"""Which inputs are fed back, and their values where a route begins."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from me2e_compress.display import reason
from me2e_compress.driving.contract import fed, fits, zeros
from me2e_compress.errors import EvaluationError
from me2e_compress.registry.documents import UNREADABLE, check_regular
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, Session, SessionPort

ZEROS = "zeros"
_FILES = (".npy", ".npz")


class RecurrentEntry(BaseModel):
    """One entry of ``[recurrent]``; a text alone is the output.

    Attributes:
        answer: The output that is fed back; in the file ``from``. None leaves it to the
            model's metadata and the naming rules.
        first: The value where a route begins: ``zeros``; a file ``.npy``, or ``.npz``
            with an array of the input's name, relative to the adapter; or an input of
            the graph, whose value at that moment it takes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    answer: str | None = Field(default=None, alias="from")
    first: str = ZEROS

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        return {"from": value} if isinstance(value, str) else value

    @field_validator("first")
    @classmethod
    def _beside(cls, text: str, info: ValidationInfo) -> str:
        """Resolve a file relative to the adapter."""
        if Path(text).suffix in _FILES and info.context is not None:
            return str(info.context / text)
        return text

    @property
    def file(self) -> Path | None:
        """The file of the first value, if it is read from one."""
        path = Path(self.first)
        return path if path.suffix in _FILES else None


Entries = Mapping[str, RecurrentEntry] | None


def answers_by_input(
    session: Session, entries: Entries, fed_otherwise: set[str]
) -> dict[str, str]:
    """Return each recurrent input with the output that answers it.

    The pairs of the model's own metadata are added to the adapter's entries, except for
    inputs in ``fed_otherwise``, which the adapter feeds.
    """
    own = {k: v for k, v in session.recurrent.items() if k not in fed_otherwise}
    found: dict[str, str] = {}
    for name, entry in (entries or {}).items():
        answer = entry.answer or own.get(name)
        if answer is None:
            raise EvaluationError(
                f"recurrent input {name}: no output answers it by its name; say from ="
                f" one of {', '.join(session.outputs)}"
            )
        found[name] = answer
    return {**own, **found}


@dataclass(frozen=True)
class FirstValues:
    """What recurrent inputs hold at the first decision of a route.

    ``held`` values are read from files; ``given`` maps a recurrent input to the input
    whose value it takes; ``zeros`` are for inputs that only the adapter calls
    recurrent.
    """

    held: Mapping[str, Array]
    given: Mapping[str, str]
    zeros: Mapping[str, Array]

    @classmethod
    def of(
        cls, session: Session, entries: Entries, recurrent: Mapping[str, str]
    ) -> Self:
        """Read the files, and check every value against its input."""
        held: dict[str, Array] = {}
        given: dict[str, str] = {}
        ports = session.inputs
        for name, entry in (entries or {}).items():
            where = f"first value of {name}: {entry.first}"
            if entry.file is not None:
                held[name] = _from_file(entry.file, name, ports[name], where)
            elif entry.first != ZEROS:
                given[name] = _input(entry.first, ports[name], ports, recurrent, where)
        # all others start from zeros
        known = {*held, *given, *session.recurrent}
        others = [name for name in recurrent if name not in known]
        return cls(held, given, {name: zeros(name, ports[name]) for name in others})

    def at(self, feeds: Mapping[str, Array]) -> dict[str, Array]:
        """Return those that are not zeros, given the feeds of the first decision."""
        return {**self.held, **{to: feeds[name] for to, name in self.given.items()}}


def _from_file(path: Path, name: str, port: SessionPort, where: str) -> Array:
    value = _read(path, name, where)
    _check(value, port, where)
    return fed(value, port)


def _read(path: Path, name: str, where: str) -> Array:
    """Read an array; from an ``.npz``, the one named like the input."""
    try:
        check_regular(path)
        held = np.load(path, allow_pickle=False)
        if isinstance(held, np.ndarray):
            return np.asarray(held)
        with held:
            return np.asarray(held[name])
    except KeyError as error:
        raise EvaluationError(f"{where} holds no array {name}") from error
    except UNREADABLE as error:
        raise EvaluationError(f"{where} cannot be read: {reason(error)}") from error


def _input(
    source: str,
    port: SessionPort,
    ports: Mapping[str, SessionPort],
    recurrent: Mapping[str, str],
    where: str,
) -> str:
    if source not in ports or source in recurrent:
        plain = ", ".join(name for name in ports if name not in recurrent)
        raise EvaluationError(
            f"{where} is none of {ZEROS}, a file .npy or .npz, and an input that is not"
            f" recurrent; those are {plain or 'none'}"
        )
    other = ports[source]
    if other.type != port.type or not fits(other.shape, port.shape):
        raise EvaluationError(
            f"{where} is {other.type} {list(other.shape)}, the input takes {port.type}"
            f" {list(port.shape)}"
        )
    return source


def _check(value: Array, port: SessionPort, where: str) -> None:
    missing = max(0, len(port.shape) - value.ndim)
    if not fits((1,) * missing + value.shape, port.shape):
        raise EvaluationError(
            f"{where} has shape {list(value.shape)}, the input takes {list(port.shape)}"
        )
    if not np.can_cast(value.dtype, DTYPES[port.type], "same_kind"):
        raise EvaluationError(f"{where} is {value.dtype}, the input takes {port.type}")
