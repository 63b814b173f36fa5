"""A policy made by a Python function, without a package of its own."""

import hashlib
import importlib
import importlib.util
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, cast

from me2e_compress.driving.contract import Policy
from me2e_compress.driving.policies import POLICIES, Driver, opened
from me2e_compress.errors import EvaluationError

_FACTORY = re.compile(r"(?P<module>[A-Za-z_][\w.]*):(?P<name>[A-Za-z_]\w*)")


@dataclass(frozen=True)
class PythonDriver(Driver):
    """Calls a function, or a class, that makes a policy.

    Attributes:
        factory: ``package.module:function``, called without arguments; it returns a
            policy or a driver. Modules are looked for in the working folder, too.
    """

    name: ClassVar[str] = "python"
    factory: str

    def __post_init__(self) -> None:
        if _FACTORY.fullmatch(self.factory) is None:
            raise EvaluationError(
                f"{self.factory!r} is not of the form package.module:function"
            )

    def open(self) -> Policy:
        """Import the module and make the policy."""
        module, name = self.factory.split(":")
        _look_here()
        try:
            make = getattr(importlib.import_module(module), name, None)
            if not callable(make):
                raise EvaluationError(f"{module} has no function {name}")
            made = make()
            return opened(made) if isinstance(made, Driver) else cast("Policy", made)
        except Exception as error:  # whatever code of theirs may raise: chained
            words = " ".join(str(error).split())
            if not isinstance(error, EvaluationError):
                words = f"{type(error).__name__}: {words}"
            raise EvaluationError(f"policy {self.factory}: {words}") from error

    @property
    def label(self) -> str:
        """The text as it was given."""
        return self.factory

    def fingerprint(self) -> str:
        """Return its text and a digest of the module's file."""
        _look_here()
        found = importlib.util.find_spec(self.factory.split(":")[0])
        text = POLICIES.text(self)
        if found is None or found.origin is None or not Path(found.origin).is_file():
            return text
        return f"{text}+{hashlib.sha256(Path(found.origin).read_bytes()).hexdigest()}"


def _look_here() -> None:
    """Let modules of the working folder be imported, after all others."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
