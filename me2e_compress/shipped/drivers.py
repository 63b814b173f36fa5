"""Trained models that come with the package, each with a card and digests."""

import functools
import hashlib
from pathlib import Path
from typing import Self

import pydantic

from me2e_compress.base import atomic
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.documents import reading
from me2e_compress.base.errors import GraphError


def write_model_file(path: Path, content: bytes) -> Path:
    """Write a file atomically, and its folders if needed; a GraphError if it cannot."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraphError(
            f"{path}: its folder cannot be made: {error.strerror}"
        ) from error
    with atomic.writing_errors(path, GraphError):
        write_bytes(path, content)
    return path


# One `NAME.onnx`, `NAME.json` and `NAME-frames` per model
WEIGHTS = Path(__file__).with_name("weights")
SHIPPED = ("highway",)  # names of the models, and of their module maps


def map_name(path: Path) -> str | None:
    """Return the name of a shipped file's module map; None of any other file."""
    return path.stem if path.parent == WEIGHTS and path.stem in SHIPPED else None


class TrainingData(pydantic.BaseModel):
    """Seeds of the training routes, none used for evaluation, and frames."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    seeds: tuple[int, ...]
    frames: int = pydantic.Field(ge=0)


class ModelCard(pydantic.BaseModel):
    """The card of a shipped model; the model's files must have its digests."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    # of the `.onnx`, lower-case hex
    sha256: str = pydantic.Field(pattern="^[0-9a-f]{64}$")
    bytes: int = pydantic.Field(gt=0)  # of the `.onnx`
    parameters: int = pydantic.Field(gt=0)  # number of trained parameters
    seed: int  # of the initial weights and of all random choices in training
    data: TrainingData
    # a description of the training, and a command that trains such a model
    command: str
    # of training, on the machine that the page of `command` names; None: not measured
    hours: float | None = None
    # by name including the unit (`driving_score_percent`); None: not measured, as a
    # whole or one by one
    scores: dict[str, float | None] | None = None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a card.

        Raises:
            GraphError: the file is missing or not a card.
        """
        with reading(path, GraphError, "not a model card"):
            return cls.model_validate_json(path.read_bytes(), strict=True)


def card(name: str) -> ModelCard:
    """Return the card of a shipped model.

    Raises:
        GraphError: unknown model, or its card is missing or malformed.
    """
    if name not in SHIPPED:
        raise GraphError(f"no model {name!r} ships; there is {', '.join(SHIPPED)}")
    return ModelCard.load(WEIGHTS / f"{name}.json")


def shipped_model(name: str) -> Path:
    """Return the file of a shipped model after checking its digest, once per process.

    Raises:
        GraphError: unknown model, or its file or card is missing or altered.
    """
    return _check_digest(WEIGHTS / f"{name}.onnx", card(name).sha256)


def frames_of(model: Path) -> Path | None:
    """Return the folder of two recorded frames for a copy of a shipped model, or None.

    They suffice to verify exact passes, but not to calibrate.
    """
    name = _shipped_name(model)
    frames = WEIGHTS / f"{name}-frames"
    return frames if name is not None and frames.is_dir() else None


def is_copy(path: Path) -> bool:
    """Return whether a path is a file with the content of a shipped model."""
    return path.is_file() and _shipped_name(path) is not None


def _shipped_name(model: Path) -> str | None:
    """Return the name of the shipped model that a file is a copy of."""
    for name in SHIPPED:
        known = card(name)
        if model.stat().st_size != known.bytes:
            continue
        if hashlib.sha256(model.read_bytes()).hexdigest() == known.sha256:
            return name
    return None


@functools.cache
def _check_digest(path: Path, expected: str) -> Path:
    """Return a path whose file has a SHA-256 in hex; else raise a GraphError."""
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise GraphError(
            f"{path}: cannot be read: {error.strerror}; expected sha256 {expected}"
        ) from error
    if digest != expected:
        raise GraphError(
            f"{path}: altered or incomplete: sha256 {digest}, expected {expected}"
        )
    return path


def copy(name: str, target: Path) -> Path:
    """Write a copy of a shipped model atomically and return its path.

    Raises:
        GraphError: as `shipped`, or ``target`` is the shipped file or cannot be
            written.
    """
    source = shipped_model(name)
    if target.exists() and target.samefile(source):
        raise GraphError(f"{target} is the shipped model: choose another output")
    return write_model_file(target, source.read_bytes())
