"""Options of an agent, its route's folder, and the agent that it wraps."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Self

from pydantic import BaseModel, ConfigDict

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import documents


class AgentOptions(BaseModel):
    """The contents of a TOML file; relative paths start where the leaderboard runs."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file."""
        with documents.reading(path, EvaluationError, "not options of an agent"):
            return cls.model_validate(documents.from_toml(documents.content(path)))


def conf_parts(text: str) -> tuple[Path, str]:
    """Split the leaderboard's configuration text into file and save name.

    Bench2Drive's evaluator appends ``+save_name`` for every route and never removes it,
    so the first field is the file and the last the name of this route, if there are two
    or more; else the name is empty.
    """
    first, *others = text.split("+")
    return Path(first), others[-1] if others else ""


def route_folder(parent: Path, save_name: str) -> Path:
    """Make the folder of one route, by its save name or the next free number."""
    folder, number = parent / save_name, 0
    while not save_name and (folder := parent / f"route-{number:03}").exists():
        number += 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EvaluationError(f"{folder}: cannot be made: {error.strerror}") from error
    return folder


def agent_module(text: str) -> ModuleType:
    """Import an agent's module as the leaderboard does: its folder is on the path."""
    if not text.endswith(".py"):
        return importlib.import_module(text)
    path = Path(text)
    if not path.is_file():
        raise EvaluationError(f"agent {text}: no such file")
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    return importlib.import_module(path.stem)


def agent_class(module: ModuleType) -> Any:
    """Return the class that a module's entry point names; ROS agents are refused."""
    if not hasattr(module, "get_entry_point"):
        raise EvaluationError(f"agent {module.__name__} has no get_entry_point")
    found = getattr(module, module.get_entry_point())
    if found.get_ros_version() != -1:
        raise EvaluationError(
            f"agent {module.__name__} is one of ROS: it has no run_step to wait for"
        )
    return found


def function_named(text: str) -> Callable[[], object]:
    """Import what ``module:function`` names."""
    if not text:
        return lambda: None
    module, _, name = text.partition(":")
    try:
        found: Callable[[], object] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise EvaluationError(f"synchronize {text!r}: {error}") from error
    return found
