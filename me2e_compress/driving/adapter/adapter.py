"""The TOML file that adapts a model."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from me2e_compress.driving.adapter.controls import ControlAdapter
from me2e_compress.driving.adapter.feeds import Feed
from me2e_compress.driving.adapter.image_inputs import ImageInput, ImageNormalization
from me2e_compress.driving.adapter.recurrent import RecurrentEntry
from me2e_compress.driving.axes import Axes
from me2e_compress.errors import EvaluationError
from me2e_compress.graph.files import sha256_of
from me2e_compress.graph.recurrence import RECURRENT, declared_pairs
from me2e_compress.registry import documents
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter

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
        control: Which outputs are the controls, which drive in place of the plan.
        image: Normalisation of image inputs that have none of their own.
        axes: Ground frame of the model.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    inputs: dict[Contract, str] = {}
    feeds: dict[str, Feed] = {}
    images: dict[str, ImageInput] = {}
    recurrent: dict[str, RecurrentEntry] | None = None
    plan: PlanAdapter | None = None
    control: ControlAdapter | None = None
    image: ImageNormalization | None = None
    axes: Axes = Axes.FORWARD_LEFT

    @model_validator(mode="after")
    def _one_driver(self) -> Self:
        if self.plan is not None and self.control is not None:
            raise ValueError("plan and control both drive: leave one out")
        return self

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file."""
        try:
            content = documents.from_toml(documents.content(path))
        except OSError as error:
            raise EvaluationError(f"{path}: {error.strerror}") from error
        except documents.MalformedError as error:
            raise EvaluationError(f"{path}: not TOML: {error}") from error
        return cls.parse(content, f"{path}: adapter", path.parent)

    @classmethod
    def parse(cls, content: object, origin: str, folder: Path | None = None) -> Self:
        """Read what a document holds; ``origin`` is its name in error messages."""
        try:
            return cls.model_validate(content, context=folder)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            words = first["msg"].removeprefix("Value error, ")
            raise EvaluationError(f"{origin} {where}: {words}") from error

    @classmethod
    def digest(cls, path: Path) -> str:
        """Return what identifies an adapter together with the files that it names."""
        entries = (cls.load(path).recurrent or {}).values()
        files = [path, *(each.file for each in entries if each.file is not None)]
        if missing := [file for file in files if not file.is_file()]:
            raise EvaluationError(f"{path}: adapter: no such file: {missing[0]}")
        return "+".join(map(sha256_of, files))

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
        said = {RECURRENT: json.dumps(pairs)} if pairs else {}
        if self.plan is not None:
            picks = self.plan.command_input
            renamed = self.inputs.get("command") if picks == "command" else None
            plan = self.plan.model_copy(update={"command_input": renamed or picks})
            said[PLAN] = plan.model_dump_json(exclude_none=True)
        return said

    def to_ego(self, waypoints: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Turn [n, 2] waypoints of the model's frame into the ego frame."""
        return np.asarray(waypoints @ self.axes.to_ego[:2, :2].T)
