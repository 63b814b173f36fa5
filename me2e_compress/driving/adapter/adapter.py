"""The TOML file that adapts a model."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from me2e_compress.driving.adapter.image_inputs import ImageInput, ImageNormalization
from me2e_compress.driving.input_sources import (
    INPUT_SOURCES,
    Axes,
    InputSource,
    Observed,
)
from me2e_compress.driving.input_sources.sources import NavigationCommand
from me2e_compress.errors import FORMER, EvaluationError
from me2e_compress.graph.recurrence import RECURRENT, declared_pairs
from me2e_compress.registry import documents
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter

# Which inputs are fed back, and their values where a route begins.


ZEROS = "zeros"


class RecurrentEntry(BaseModel):
    """One entry of ``[recurrent]``; a text alone is the output.

    Attributes:
        answer: The output that is fed back; in the file ``from``. None leaves it to the
            model's metadata and the naming rules.
        first: The value where a route begins: ``zeros``, or an input of the graph,
            whose value at that moment it takes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    answer: str | None = Field(default=None, alias="from")
    first: str = ZEROS

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        return {"from": value} if isinstance(value, str) else value


# One input of a graph, made of input sources.


Levels = float | tuple[float, ...]

LARGEST = 1e30
"""The largest mean or std: within float32."""


@dataclass(frozen=True)
class FeedPart:
    """A source, normalised: (value - mean) / std.

    ``mean`` and ``std`` are one number, or as many as the last dimension has.
    """

    source: InputSource
    mean: Levels = 0.0
    std: Levels = 1.0

    @classmethod
    def read(cls, table: dict[str, Any]) -> Self:
        """Read a table: source, mean, std, and the source's own options."""
        options = dict(table)
        name = options.pop("source", None)
        if not isinstance(name, str):
            names = ", ".join(INPUT_SOURCES.names())
            raise ValueError(f"no source is named; there are {names}")
        # what is left of the table are the source's options
        mean = _levels("mean", options.pop("mean", 0.0))
        std = _levels("std", options.pop("std", 1.0))
        if not np.all(std):
            raise ValueError(f"{name}: std is zero")
        try:
            return cls(INPUT_SOURCES.build(name, options), mean, std)
        except EvaluationError as error:
            raise ValueError(str(error)) from error

    def value(self, seen: Observed) -> Array:
        """Return the normalised value, of the source's shape."""
        array = self.source.value(seen)
        if self.mean == 0.0 and self.std == 1.0:
            return array
        try:
            scaled: Array = (array - np.array(self.mean)) / np.array(self.std)
        except ValueError as error:
            raise EvaluationError(
                f"{self.source.name}: mean or std: {error}"
            ) from error
        # numpy may have broadcast to a larger shape
        if scaled.shape != array.shape:
            raise EvaluationError(
                f"{self.source.name}: mean and std make {list(scaled.shape)} of its "
                f"shape {list(array.shape)}"
            )
        return scaled


class Feed(BaseModel):
    """How one input is made: of a source, or of parts in a row.

    As a table: ``source`` and its options, ``mean``, ``std``; or ``parts``, a list of
    such tables, whose numbers are flattened and concatenated (``joined``).
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    parts: tuple[FeedPart, ...]
    joined: bool = False

    @model_validator(mode="before")
    @classmethod
    def _of_table(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            raise ValueError("it must be a table with a source, or with parts")
        if "parts" not in table:
            return {"parts": (FeedPart.read(table),)}
        # parts, each a table of its own
        listed = table["parts"]
        if not (isinstance(listed, list) and listed) or len(table) > 1:
            raise ValueError("parts must be a list of tables, and stand alone")
        if not all(isinstance(each, dict) for each in listed):
            raise ValueError("each of parts must be a table with a source")
        return {"parts": tuple(map(FeedPart.read, listed)), "joined": True}

    @classmethod
    def by(cls, source: InputSource) -> Self:
        """Return the feed of one source without normalisation."""
        return cls.model_construct(parts=(FeedPart(source),))

    def value(self, seen: Observed) -> Array:
        """Return the input's value, without a batch dimension."""
        arrays = [part.value(seen) for part in self.parts]
        if not self.joined:
            return arrays[0]
        return np.concatenate([each.reshape(-1) for each in arrays])

    def sizes(self, seen: Observed) -> str:
        """Name the sources with their element counts, for messages."""
        parts = ((p.source.name, p.source.value(seen).size) for p in self.parts)
        return ", ".join(f"{name} {size}" for name, size in parts)

    @property
    def command(self) -> NavigationCommand | None:
        """The navigation command, if the feed is nothing else."""
        source = self.parts[0].source
        if len(self.parts) > 1 or not isinstance(source, NavigationCommand):
            return None
        return source


def _levels(name: str, value: Any) -> Levels:
    numbers = value if isinstance(value, list) else [value]
    if not numbers or not all(
        isinstance(each, int | float)
        and not isinstance(each, bool)
        and abs(each) <= LARGEST
        for each in numbers
    ):
        raise ValueError(f"{name} must be a finite number, or a list of such")
    return tuple(map(float, value)) if isinstance(value, list) else float(value)


Contract: TypeAlias = Literal["img", "lidar2img", "can_bus", "command", "timestamp"]


class Adapter(BaseModel):
    """The contents of a TOML adapter; what is left out follows from the model.

    Attributes:
        inputs: The contract's name (img, lidar2img, can_bus, command, timestamp) to the
            graph's.
        feeds: The sources of each other input of the graph, by its name.
        images: The settings of each image input, by its name.
        recurrent: Recurrent input to the output that answers it, and to its first
            value; inputs that the adapter feeds in another way are not recurrent.
        plan: Which output is the plan, the times of its waypoints, whether it holds
            steps, which mode is taken; ``command_input = "command"`` lets the
            navigator's command pick it.
        image: Normalisation of image inputs that have none of their own.
        axes: Ground frame of the model.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    inputs: dict[Contract, str] = {}
    feeds: dict[str, Feed] = {}
    images: dict[str, ImageInput] = {}
    recurrent: dict[str, RecurrentEntry] | None = None
    plan: PlanAdapter | None = None
    image: ImageNormalization | None = None
    axes: Axes = Axes.FORWARD_LEFT

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file."""
        with documents.reading(path, EvaluationError, "not TOML"):
            content = documents.from_toml(documents.content(path))
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
            words = FORMER.get(f"adapter key {where}", words)
            raise EvaluationError(f"{origin} {where}: {words}") from error

    def metadata(self, own: Mapping[str, str]) -> dict[str, str]:
        """Return the adapter's recurrent pairs and plan in the form of graph metadata.

        ``own`` is the graph's own metadata, which holds for what the adapter does not
        name.
        """
        named = (self.recurrent or {}).items()
        pairs = {
            **(declared_pairs(own) or {}),
            **dict.fromkeys((*self.feeds, *self.images)),
            **{name: each.answer for name, each in named if each.answer is not None},
        }
        # the plan's mode may be picked by an input of another name
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
