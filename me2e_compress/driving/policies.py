"""Policies by name: data from which any process can open a policy.

To add a policy: write its class, then add it to this table.
"""

import abc
import hashlib
import importlib
import importlib.util
import re
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, Protocol, cast, runtime_checkable

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.registry import Registry
from me2e_compress.base.text import name_in
from me2e_compress.driving.contract import Policy

__all__ = [
    "MODEL",
    "POLICIES",
    "PYTHON",
    "Driver",
    "SizedPolicy",
    "driver_named",
    "opened",
]


@runtime_checkable
class SizedPolicy(Policy, Protocol):
    """A policy that wants its images in a size of its own."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of each camera."""
        ...


@dataclass(frozen=True)
class Driver(abc.ABC):
    """Opens a policy: derive a frozen dataclass whose fields are the options."""

    name: ClassVar[str]

    @abc.abstractmethod
    def open(self) -> Policy:
        """Return the policy, ready to be reset.

        Raises:
            EvaluationError: It cannot drive.
        """

    def resolved(self) -> "Driver":
        """Return the driver that this one is an alias of; else itself."""
        return self

    @property
    def label(self) -> str:
        """The name in tables and pictures."""
        return POLICIES.text(self)

    def fingerprint(self) -> str:
        """Return what identifies the policy in results: its text, digests of its files.

        Override it if anything else decides what the policy does.
        """
        values = (getattr(self, field.name) for field in fields(self))
        files = [value for value in values if isinstance(value, Path)]
        return "+".join([POLICIES.text(self), *map(_sha256, files)])


_HIGHWAY = "me2e_compress.evaluators.highway.drivers"
_SHIPPED = "me2e_compress.commands.shipped_driver"

POLICIES: Registry[Driver] = Registry(
    "policy",
    "me2e_compress.policies",
    EvaluationError,
    {
        "onnx": f"{_HIGHWAY}:OnnxDriver",
        "highway": f"{_SHIPPED}:ShippedDriver",
        "python": "me2e_compress.driving.policies:PythonDriver",
    },
)

MODEL = "onnx"  # the policy of a text that is a path

PYTHON = "python"  # the policy of a text ``package.module:function``

_MEMBERS = ("needs_images", "privileged", "reset", "plan")
_FACTORY = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


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
        # Import and call their code; any error of it is one line
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
        spec = importlib.util.find_spec(self.factory.split(":")[0])
        text = POLICIES.text(self)
        if spec is None or spec.origin is None or not Path(spec.origin).is_file():
            return text
        return f"{text}+{_sha256(Path(spec.origin))}"


def driver_named(
    text: str, adapter: str | Path | None = None, module_map: str | Path | None = None
) -> Driver:
    """Build the driver of a text: a policy with its options, or an ONNX file's path.

    Args:
        text: ``onnx{path=M.onnx, adapter=A.toml}``,
            ``highway`` for the driver that ships, the name of another package's policy,
            ``package.module:function`` for a Python function's result, or else a path.
        adapter: TOML file that adapts a model; a policy without models ignores it.
        module_map: preset or TOML file that says plan and state of a model; likewise.

    Raises:
        EvaluationError: An option that the policy has not, or refuses.
        MissingExtraError: The package that it needs is not installed.
    """
    # A registered policy, a Python function, or else a file
    if name_in(text) in POLICIES.names():
        driver = POLICIES.parse(text)
        if not isinstance(driver, Driver):
            raise EvaluationError(
                f"policy {name_in(text)!r} is a {type(driver).__name__}, which is no"
                " Driver: derive it from me2e_compress.driving.policies.Driver"
            )
        driver = driver.resolved()
    elif _FACTORY.fullmatch(text) and not Path(text).exists():
        driver = POLICIES.build(PYTHON, {"factory": text})
    else:
        driver = POLICIES.build(MODEL, {"path": text})
    # Options of the command go to policies that have them
    files = {"adapter": adapter, "module_map": module_map and str(module_map)}
    fields = type(driver).__dataclass_fields__
    options = {k: v for k, v in files.items() if v is not None and k in fields}
    return POLICIES.with_options(driver, options) if options else driver


def opened(driver: Driver) -> Policy:
    """Open a driver's policy, and check that it has the members of `Policy`.

    Raises:
        EvaluationError: It cannot be opened, or lacks a member.
    """
    policy = driver.open()
    if lacks := [member for member in _MEMBERS if not hasattr(policy, member)]:
        raise EvaluationError(
            f"policy {driver.label}: a {type(policy).__name__} is no policy: it has no"
            f" {', '.join(lacks)}"
        )
    return policy


def _look_here() -> None:
    """Let modules of the working folder be imported, after all others."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
