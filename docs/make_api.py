"""Build the API reference from the docstrings: ``make docs``."""

import pkgutil
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pdoc

import me2e_compress


def modules() -> Iterator[str]:
    """Name every module but the command line's and the programs."""
    yield me2e_compress.__name__
    for found in pkgutil.walk_packages(me2e_compress.__path__, "me2e_compress."):
        room = found.name.split(".")[1]
        if room not in ("cli", "__main__") and not found.name.endswith("_main"):
            yield found.name


def main(folder: Path) -> None:
    """Write one page a module; names that load when asked for are asked for first."""
    for name in me2e_compress.__all__:
        setattr(me2e_compress, name, getattr(me2e_compress, name))
    # a package without __all__ is walked by pdoc itself, too
    warnings.filterwarnings("ignore", "The module specification")
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*modules(), output_directory=folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
