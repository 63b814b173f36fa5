"""The adapters that come with the package."""

from importlib import resources
from pathlib import Path

from me2e_compress.base.errors import EvaluationError

__all__ = ["adapter_file", "shipped_adapters"]


def shipped_adapters() -> list[str]:
    """List their names."""
    folder = resources.files(__name__)
    names = (file.name for file in folder.iterdir() if file.name.endswith(".toml"))
    return sorted(name.removesuffix(".toml") for name in names)


def adapter_file(named: Path) -> Path:
    """Return the file of a path or a shipped name; an existing file wins."""
    if named.is_file():
        return named
    if str(named) in shipped_adapters():
        return Path(str(resources.files(__name__) / f"{named}.toml"))
    line = f"adapter {named}: no such file; we ship {', '.join(shipped_adapters())}"
    raise EvaluationError(line)
