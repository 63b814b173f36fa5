"""Checkpoints of training, one file each."""

import os
import pickle
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from models.driver.errors import TrainingError

Weights = Mapping[str, Tensor]


@dataclass(frozen=True, eq=False)
class Start:
    """What a stage starts from: of a `TrainingCheckpoint`, or of the file that ships.

    Attributes:
        mean: weights and buffers that drive.
        lamps: of the extra head.
    """

    mean: Weights
    lamps: Weights

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the two of a checkpoint, or of the file that ships.

        Raises:
            TrainingError: it lacks one.
        """
        return cls(**_read(path, [field.name for field in fields(cls)]))


@dataclass(frozen=True, eq=False)
class TrainingCheckpoint:
    """Everything that resuming needs.

    Attributes:
        model: weights and buffers that learn.
        mean: their running mean, which drives.
        lamps: of the extra head.
        optimizer: its state.
        step: optimizer steps taken.
        what: the `Training` as JSON.
    """

    model: Weights
    mean: Weights
    lamps: Weights
    optimizer: dict[str, Any]
    step: int
    what: str

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a checkpoint.

        Raises:
            TrainingError: it is not one.
        """
        return cls(**_read(path, [field.name for field in fields(cls)]))

    def handed_on(self, *, needed: bool) -> Self:
        """Return what is kept of a stage at its end: not the state of learning.

        Args:
            needed: whether a stage is still to begin with its weights.
        """
        kept = replace(self, model={}, optimizer={})
        return kept if needed else replace(kept, mean={}, lamps={})

    def save(self, path: Path) -> None:
        """Write it atomically.

        Raises:
            TrainingError: it cannot be written.
        """
        content = {field.name: getattr(self, field.name) for field in fields(self)}
        try:
            with tempfile.TemporaryDirectory(
                dir=path.parent, prefix=".saving-"
            ) as near:
                torch.save(content, draft := Path(near) / path.name)
                os.replace(draft, path)
        except (OSError, RuntimeError) as error:
            first = str(error).splitlines()[0]
            raise TrainingError(f"{path}: cannot be written: {first}") from error


def _read(path: Path, names: Sequence[str]) -> dict[str, Any]:
    try:
        found = torch.load(path, weights_only=True)
        return {name: found[name] for name in names}
    except (OSError, EOFError, RuntimeError, pickle.UnpicklingError) as error:
        first = str(error).splitlines()[0] if str(error) else "it is empty"
        raise TrainingError(f"{path}: not a checkpoint: {first}") from error
    except (KeyError, IndexError, TypeError) as error:
        raise TrainingError(
            f"{path}: not a checkpoint of training: it lacks {error}"
        ) from error


def fit(module: nn.Module, weights: Weights, path: Path) -> None:
    """Load the weights of a checkpoint into a module.

    Args:
        module: that gets them.
        weights: by the names of its state.
        path: of the checkpoint, for the message.

    Raises:
        TrainingError: they are of another model.
    """
    wanted = module.state_dict()
    for name in sorted({*wanted, *weights}):
        there = [
            None if name not in state else list(state[name].shape)
            for state in (weights, wanted)
        ]
        if there[0] != there[1]:
            found, own = ("missing" if one is None else str(one) for one in there)
            raise TrainingError(
                f"{path}: a checkpoint of another model: {name} is {found} in it, "
                f"{own} in this one"
            )
    module.load_state_dict(weights)
