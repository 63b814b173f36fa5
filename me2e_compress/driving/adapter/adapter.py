"""The TOML file that adapts a model."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter.image_inputs import ImageInput, ImageNormalization
from me2e_compress.driving.input_sources import (
    INPUT_SOURCES,
    Axes,
    InputSource,
    Observed,
)
from me2e_compress.graph.recurrence import RECURRENT, declared_pairs
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter

# Which inputs are fed back, and their values where a route begins.


ZEROS = "zeros"


class RecurrentEntry(BaseModel):
    """One entry of ``[recurrent]``; a text alone is the output."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # The output that is fed back; None leaves it to metadata and naming rules
    answer: str | None = Field(default=None, alias="from")
    # The value where a route begins: zeros, or that of this input of the graph
    first: str = ZEROS

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        return {"from": value} if isinstance(value, str) else value


# One input of a graph, made of input sources.


LARGEST = 1e30  # the largest mean or std: within float32
Level = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Levels = Level | Annotated[tuple[Level, ...], Field(min_length=1)]


class FeedPart(BaseModel):
    """A source, normalised: (value - mean) / std.

    As a table: ``source``, its own options, ``mean`` and ``std``, which are one number,
    or as many as the last dimension has.
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    source: InputSource
    mean: Levels = 0.0
    std: Levels = 1.0

    @model_validator(mode="before")
    @classmethod
    def _of_table(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("source"), str):
            names = ", ".join(INPUT_SOURCES.names())
            raise ValueError(f"no source is named; there are {names}")
        own = {key: table[key] for key in ("mean", "std") if key in table}
        options = {k: v for k, v in table.items() if k != "source" and k not in own}
        try:
            return {"source": INPUT_SOURCES.build(table["source"], options), **own}
        except EvaluationError as error:
            raise ValueError(str(error)) from error

    @model_validator(mode="after")
    def _divides(self) -> Self:
        if not np.all(self.std):
            raise ValueError(f"{self.source.name}: std is zero")
        return self

    def value(self, seen: Observed) -> Array:
        """Return the normalised value, of the source's shape."""
        array = self.source.value(seen)
        if self.mean == 0.0 and self.std == 1.0:
            return array
        name = self.source.name
        try:
            scaled: Array = (array - np.array(self.mean)) / np.array(self.std)
        except ValueError as error:
            raise EvaluationError(f"{name}: mean or std: {error}") from error
        # numpy may have broadcast to a larger shape
        if scaled.shape != array.shape:
            shapes = f"{list(scaled.shape)} of its shape {list(array.shape)}"
            raise EvaluationError(f"{name}: mean and std make {shapes}")
        return scaled


class Feed(BaseModel):
    """How one input is made: of a source, or of parts in a row.

    As a table: that of one part; or ``parts``, a list of such tables, whose numbers are
    flattened and concatenated (``joined``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    parts: Annotated[tuple[FeedPart, ...], Field(min_length=1)]
    joined: bool = False

    @model_validator(mode="before")
    @classmethod
    def _of_table(cls, table: Any) -> Any:
        if isinstance(table, dict) and "parts" in table:
            return {**table, "joined": True}
        return {"parts": (table,)}

    def value(self, seen: Observed) -> Array:
        """Return the input's value, without a batch dimension."""
        arrays = [part.value(seen) for part in self.parts]
        if not self.joined:
            return arrays[0]
        return np.concatenate([array.reshape(-1) for array in arrays])


Contract: TypeAlias = Literal["img", "lidar2img", "can_bus", "command", "timestamp"]


class Adapter(BaseModel):
    """The contents of a TOML adapter; what is left out follows from the model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    inputs: dict[Contract, str] = {}  # the contract's name to the graph's
    feeds: dict[str, Feed] = {}  # by input of the graph
    images: dict[str, ImageInput] = {}  # by input of the graph
    # By recurrent input; inputs that the adapter feeds in another way are not recurrent
    recurrent: dict[str, RecurrentEntry] | None = None
    plan: PlanAdapter | None = None  # which output is the plan, and how it is read
    image: ImageNormalization | None = None  # of image inputs without one of their own
    axes: Axes = Axes.FORWARD_LEFT  # ground frame of the model

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file."""
        with documents.reading(path, EvaluationError, "not TOML"):
            content = documents.from_toml(documents.read_bytes(path))
        return cls.parse(content, f"{path}: adapter")

    @classmethod
    def parse(cls, content: object, origin: str) -> Self:
        """Read what a document holds; ``origin`` is its name in error messages."""
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            words = first["msg"].removeprefix("Value error, ")
            raise EvaluationError(f"{origin} {where}: {words}") from error

    def metadata(self, own: Mapping[str, str]) -> dict[str, str]:
        """Return the adapter's recurrent pairs and plan in the form of graph metadata.

        ``own`` is the graph's own metadata, which holds for what the adapter does not
        name.
        """
        pairs = {**(declared_pairs(own) or {})}
        pairs |= dict.fromkeys((*self.feeds, *self.images))
        for name, entry in (self.recurrent or {}).items():
            if entry.answer is not None:
                pairs[name] = entry.answer
        # The plan's mode may be picked by an input of another name
        metadata = {RECURRENT: json.dumps(pairs)} if pairs else {}
        if self.plan is not None:
            picks = self.plan.command_input
            renamed = self.inputs.get("command") if picks == "command" else None
            plan = self.plan.model_copy(update={"command_input": renamed or picks})
            metadata[PLAN] = plan.model_dump_json(exclude_none=True)
        return metadata

    def to_ego(self, waypoints: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Turn [n, 2] waypoints of the model's frame into the ego frame."""
        return np.asarray(waypoints @ self.axes.to_ego[:2, :2].T)
