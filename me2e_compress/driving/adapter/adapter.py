"""The TOML file that adapts a model, and the inputs of a graph that it feeds."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pydantic
from pydantic import BaseModel, ConfigDict, Field, model_validator

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving import contract
from me2e_compress.driving.adapter.image_inputs import (
    CAMERA_NAMES,
    ImageInput,
    ImageNormalization,
    ImagePort,
    InputImages,
    rendered_size,
)
from me2e_compress.driving.contract import EgoKinematics, Observation, fits
from me2e_compress.driving.input_sources import (
    INPUT_SOURCES,
    Axes,
    EgoTrack,
    InputSource,
    Observed,
)
from me2e_compress.graph.recurrence import RECURRENT, declared_pairs
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter
from me2e_compress.runtime.session import DTYPES, Session, SessionPort

ZEROS = "zeros"
BYTES = "tensor(uint8)"
LARGEST = 1e30  # the largest mean or std: within float32
Level = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Levels = Level | Annotated[tuple[Level, ...], Field(min_length=1)]
Contract: TypeAlias = Literal["img", "lidar2img", "can_bus", "command", "timestamp"]
IMAGES: Literal["img"] = "img"
# Inputs of the contract that are no images, with the sources that feed them
CONTRACT: Mapping[str, str] = {
    "lidar2img": "lidar2img",
    "can_bus": "can-bus",
    "command": "command",
    "timestamp": "timestamp",
}


# Which inputs are fed back, and their values where a route begins.


class RecurrentEntry(BaseModel):
    """One entry of ``[recurrent]``; a text alone is the output."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # The output that is fed back; None leaves it to metadata and naming rules
    answer: str | None = Field(default=None, alias="from")
    first: str = ZEROS  # at a route's start: zeros, or that of an input of the graph

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        return {"from": value} if isinstance(value, str) else value


# One input of a graph, made of input sources.


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

    def value(self, observed: Observed) -> Array:
        """Return the normalised value, of the source's shape."""
        array = self.source.value(observed)
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

    def value(self, observed: Observed) -> Array:
        """Return the input's value, without a batch dimension."""
        arrays = [part.value(observed) for part in self.parts]
        if not self.joined:
            return arrays[0]
        return np.concatenate([array.reshape(-1) for array in arrays])


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
        except pydantic.ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            words = first["msg"].removeprefix("Value error, ")
            raise EvaluationError(f"{origin} {where}: {words}") from error

    def metadata(self, own: Mapping[str, str]) -> dict[str, str]:
        """Return recurrent pairs and plan, as metadata of a graph that has ``own``."""
        pairs = dict(declared_pairs(own) or {})
        pairs |= dict.fromkeys((*self.feeds, *self.images))  # None: not recurrent
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


# Convert an observation to the inputs of a graph.


@dataclass(frozen=True)
class ModelInputs:
    """How the inputs of a graph that are not recurrent are fed at each decision."""

    ports: Mapping[str, SessionPort]
    adapter: Adapter
    tables: Mapping[str, ImageInput]  # settings of image inputs
    images: Mapping[str, InputImages]  # those of them that can be fed
    sources: Mapping[str, Feed]  # inputs that are no images
    image_size: tuple[int, int]  # rows and columns in which cameras are rendered
    _track: EgoTrack = field(default_factory=EgoTrack, init=False)

    @classmethod
    def of(
        cls, session: Session, adapter: Adapter, recurrent: Mapping[str, str]
    ) -> Self:
        """Check the inputs of a graph against the contract.

        Raises:
            EvaluationError: Names the first port that cannot be fed.
        """
        _check_names(session, adapter, recurrent)
        opened, problems = cls.opened(session, adapter, recurrent)
        for problem in problems.values():
            raise EvaluationError(problem)
        return opened

    @classmethod
    def opened(
        cls, session: Session, adapter: Adapter, recurrent: Mapping[str, str]
    ) -> tuple[Self, dict[str, str]]:
        """Return what can be fed, and by input why the rest cannot."""
        ports = {k: v for k, v in session.inputs.items() if k not in recurrent}
        # Images and feeds: those of the contract that the adapter does not name, too
        named, names = {*adapter.images, *adapter.feeds}, contract_names(adapter)
        tables = {k: v for k, v in adapter.images.items() if k in ports}
        if names[IMAGES] in ports and names[IMAGES] not in named:
            tables = {names[IMAGES]: ImageInput(), **tables}
        sources = {
            names[ours]: Feed.model_validate({"source": source})
            for ours, source in CONTRACT.items()
            if names[ours] in ports and names[ours] not in named
        } | {k: v for k, v in adapter.feeds.items() if k in ports}
        # Check that every input has a source, and one that fits
        names_of_sources, problems = ", ".join(INPUT_SOURCES.names()), dict[str, str]()
        for name in [name for name in ports if name not in {**tables, **sources}]:
            problems[name] = (
                f"input {name} is none of {', '.join((IMAGES, *CONTRACT))}, no output"
                f" is known to feed it back, and the adapter has no [feeds.{name}]"
                f" (sources: {names_of_sources}) or [images.{name}]"
            )
        images, size, faults = _images(session, adapter, tables)
        opened = cls(session.inputs, adapter, tables, images, sources, size)
        return opened, {**problems, **faults, **opened.faults()}

    @property
    def cameras(self) -> tuple[int, ...]:
        """Indices among the six cameras of those that the model sees, ascending."""
        return tuple(sorted({at for e in self.images.values() for at in e.indices}))

    def reset(self) -> None:
        """Begin a route: forget the last one."""
        self._track.clear()

    def feeds(self, observation: Observation) -> dict[str, Array]:
        """Convert an observation to the graph's inputs; call it once per decision."""
        arrays: dict[str, Array] = {}
        for name, image in self.images.items():
            if observation.images is None:
                raise EvaluationError("the model needs images, and none were rendered")
            arrays[name] = image.apply(observation.images)
        # Inputs that are no images may need the ego's track
        self._track.note(observation.time_us, observation.motion)
        observed = self._observed(observation)
        arrays |= {name: feed.value(observed) for name, feed in self.sources.items()}
        return {
            name: contract.fit_to_port(array, self.ports[name])
            for name, array in arrays.items()
        }

    def blank_observation(self) -> Observation:
        """Return an observation of zeros, for a dry run."""
        still = (0.0, 0.0, 0.0)
        return Observation(
            0,
            np.zeros((len(CAMERA_NAMES), *self.image_size, 3), np.uint8),
            np.tile(np.eye(4, dtype=np.float32), (len(CAMERA_NAMES), 1, 1)),
            np.zeros(contract.CAN_BUS_SIZE, np.float32),
            0,
            0.0,
            motion=EgoKinematics(0.0, 0.0, 0.0, 0.0, still, still),
            target_points=np.zeros((2, 2), np.float32),
        )

    def _observed(self, observation: Observation) -> Observed:
        images, lidar2img = self.images.items(), observation.lidar2img
        projections = {name: image.projections(lidar2img) for name, image in images}
        projections = projections or {"": lidar2img}
        return Observed(observation, self.adapter.axes, self._track, projections)

    def faults(self) -> dict[str, str]:
        """Return the reason for each input that cannot be fed, in feed order."""
        blank, faults = self.blank_observation(), dict[str, str]()
        self._track.note(0, blank.motion)
        observed = self._observed(blank)
        for name, feed in self.sources.items():
            try:
                fault = _fault(name, self.ports[name], feed.value(observed))
            except EvaluationError as error:
                fault = f"input {name}: {error}"
            if fault:
                faults[name] = fault
        self._track.clear()
        return faults


def contract_names(adapter: Adapter) -> dict[str, str]:
    """Return the graph's name of each input of the contract."""
    return {ours: ours for ours in (IMAGES, *CONTRACT)} | {**adapter.inputs}


def _images(
    session: Session, adapter: Adapter, tables: Mapping[str, ImageInput]
) -> tuple[dict[str, InputImages], tuple[int, int], dict[str, str]]:
    """Return the image inputs, the size of the cameras, and what does not fit."""
    ports, sizes = dict[str, ImagePort](), list[tuple[int, int]]()
    images, faults = dict[str, InputImages](), dict[str, str]()
    # One rendered size serves all inputs: the largest that any of them asks for
    for name, table in tables.items():
        try:
            port = ImagePort.of(name, session.inputs[name].shape, table)
            sizes.append(rendered_size(name, table, port))
            ports[name] = port
        except EvaluationError as error:
            faults[name] = str(error)
    rows, columns = zip(*(sizes or [contract.DEFAULT_IMAGE_SIZE]), strict=True)
    rendered = max(rows), max(columns)
    for name, port in ports.items():
        try:
            # Inputs of bytes are not normalised
            norm, usual = None, adapter.image
            if session.inputs[name].type != BYTES:
                if usual is None and tables[name].mean is None:
                    usual = ImageNormalization.of(session.metadata)
                norm = tables[name].normalization(name, usual)
            image = InputImages(tables[name], port, rendered, norm)
            image.check(name)
            images[name] = image
        except EvaluationError as error:
            faults[name] = str(error)
    return images, rendered, faults


def _check_names(
    session: Session, adapter: Adapter, recurrent: Mapping[str, str]
) -> None:
    """Check that every name in the adapter exists and is used once."""
    for name, answer in recurrent.items():
        _exists(name, session.inputs, "input")
        _exists(answer, session.outputs, "output")
    for ours, name in adapter.inputs.items():
        if name != ours:
            _exists(name, session.inputs, "input")
    for name in (*adapter.images, *adapter.feeds):
        _exists(name, session.inputs, "input")
        if name in recurrent or (name in adapter.images and name in adapter.feeds):
            raise EvaluationError(f"the adapter feeds input {name} in two ways")
    for name, port in session.inputs.items():
        if port.type not in DTYPES:
            raise EvaluationError(f"input {name} is {port.type}: it cannot be fed")


def _exists(name: str, ports: Mapping[str, SessionPort], kind: str) -> None:
    if name not in ports:
        raise EvaluationError(
            f"the adapter names {kind} {name}; there are {', '.join(ports)}"
        )


def _fault(name: str, port: SessionPort, array: Array) -> str:
    """Say how an array does not fit a port, which may have a batch of one before it."""
    shape: contract.Shape = port.shape
    batch = (1,) * (len(shape) - array.ndim)
    if not fits(shape, (*batch, *array.shape)):
        return f"input {name} has shape {list(shape)}, it must be {[1, *array.shape]}"
    # The types must agree
    if not np.can_cast(array.dtype, DTYPES[port.type], "same_kind"):
        return f"input {name} is {port.type}, and what feeds it {array.dtype}"
    return ""
