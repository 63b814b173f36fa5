"""Trained models that come with the package, each with a card and digests."""

import functools
import hashlib
from pathlib import Path
from typing import Self

import pydantic

from me2e_compress.errors import GraphError
from me2e_compress.zoo.model_files import write
from me2e_compress.zoo.stacks import STACKS

WEIGHTS = Path(__file__).with_name("weights")
"""One ``NAME.onnx`` and ``NAME.json`` per model; in a checkout ``NAME.pt`` too."""

SHIPPED = tuple(stack.name for stack in STACKS.values() if stack.trained)
"""Names of the models."""


class TrainingData(pydantic.BaseModel):
    """Seeds of the training routes, none used for evaluation, and frames."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    seeds: tuple[int, ...]
    frames: int = pydantic.Field(ge=0)


class ModelCard(pydantic.BaseModel):
    """The card of a shipped model; the model's files must have its digests.

    Attributes:
        sha256: of the ``.onnx``, lower-case hex.
        bytes: of the ``.onnx``.
        checkpoint_sha256: of the ``.pt`` with the same weights in torch; None if there
            is none.
        parameters: number of trained parameters.
        seed: of the initial weights and of all random choices in training.
        data: the training data.
        command: a description of the training, and a command that trains such a model.
        hours: of training, on the machine that the page of ``command`` names; None: not
            measured.
        scores: by name including the unit (``driving_score_percent``); None: not
            measured, as a whole or one by one.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    sha256: str = pydantic.Field(pattern="^[0-9a-f]{64}$")
    bytes: int = pydantic.Field(gt=0)
    checkpoint_sha256: str | None = pydantic.Field(None, pattern="^[0-9a-f]{64}$")
    parameters: int = pydantic.Field(gt=0)
    seed: int
    data: TrainingData
    command: str
    hours: float | None = None
    scores: dict[str, float | None] | None = None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a card.

        Raises:
            GraphError: the file is missing or not a card.
        """
        try:
            return cls.model_validate_json(path.read_bytes(), strict=True)
        except OSError as error:
            raise GraphError(f"{path}: cannot be read: {error.strerror}") from error
        except pydantic.ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "the file"
            raise GraphError(f"{path}: {where}: {first['msg']}") from error


def card(name: str, folder: Path | None = None) -> ModelCard:
    """Return the card of a shipped model.

    Raises:
        GraphError: unknown model, or its card is missing or malformed.
    """
    if name not in SHIPPED:
        raise GraphError(f"no model {name!r} ships; there is {', '.join(SHIPPED)}")
    return ModelCard.load((folder or WEIGHTS) / f"{name}.json")


def shipped(name: str, folder: Path | None = None) -> Path:
    """Return the file of a shipped model after checking its digest, once per process.

    ``folder`` holds models and cards; None means those of the package.

    Raises:
        GraphError: unknown model, or its file or card is missing or altered.
    """
    return _checked(name, folder or WEIGHTS)


def checkpoint(name: str, folder: Path | None = None) -> Path:
    """Return the weights of a shipped model from which training can continue.

    It is a file of `driver.checkpoint.Start`. The repository and the source
    distribution hold it; the wheel does not. ``folder`` is as in `shipped`.

    Raises:
        GraphError: unknown model, or its checkpoint or card is missing or altered.
    """
    folder = folder or WEIGHTS
    expected = card(name, folder).checkpoint_sha256
    if expected is None:
        raise GraphError(f"{name}: its card names no checkpoint")
    path = folder / f"{name}.pt"
    if not path.exists():
        raise GraphError(
            f"{path}: the wheel leaves the checkpoint out; take"
            f" me2e_compress/zoo/weights/{name}.pt of the source distribution"
        )
    return _same(path, expected)


def sample_frames(model: Path, folder: Path | None = None) -> Path | None:
    """Return the recorded frames of a shipped model, if a file is a copy of one.

    Two frames of a drive suffice to verify exact passes, but not to calibrate.
    """
    folder = folder or WEIGHTS
    for name in SHIPPED:
        known, frames = card(name, folder), folder / f"{name}-frames"
        # Compare sizes before hashing
        if not frames.is_dir() or model.stat().st_size != known.bytes:
            continue
        if hashlib.sha256(model.read_bytes()).hexdigest() == known.sha256:
            return frames
    return None


@functools.cache
def _checked(name: str, folder: Path) -> Path:
    return _same(folder / f"{name}.onnx", card(name, folder).sha256)


def _same(path: Path, expected: str) -> Path:
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise GraphError(
            f"{path}: cannot be read: {error.strerror}; expected sha256 {expected}"
        ) from error
    if found != expected:
        raise GraphError(
            f"{path}: altered or incomplete: sha256 {found}, expected {expected}"
        )
    return path


def copy(name: str, target: Path, folder: Path | None = None) -> Path:
    """Write a copy of a shipped model atomically and return its path.

    Raises:
        GraphError: as `shipped`, or ``target`` is the shipped file or cannot be
            written.
    """
    source = shipped(name, folder)
    if target.exists() and target.samefile(source):
        raise GraphError(f"{target} is the shipped model: choose another output")
    return write(target, source.read_bytes())
