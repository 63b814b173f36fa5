"""Import an agent's class from its file, as the leaderboard does."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from me2e_compress.errors import EvaluationError


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
