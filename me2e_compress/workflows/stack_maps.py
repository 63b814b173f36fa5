"""One module map for all files of a stack."""

from pathlib import Path

from me2e_compress import graph
from me2e_compress.modules import ModuleMap, map_of_files
from me2e_compress.modules.detect import STACK
from me2e_compress.runtime.stack.split_stack import SplitStack


def map_of_stack(stack: SplitStack, named: str | Path | None) -> ModuleMap:
    """Load the map that all files share; a pattern must match in one of them."""
    models = [graph.load(each.path) for each in stack.files.values()]
    name = None if named is None else str(named)
    return map_of_files(models, stack.metadata.get(STACK), name)
