"""What the extras of the package bring, and what to install where one is missing."""

import traceback
from importlib import util

from me2e_compress.base.errors import BrokenPackageError, MissingExtraError

# The modules that each extra brings, as they are imported
MODULES = {
    "highway": ("highway_env", "gymnasium", "cv2", "jinja2", "matplotlib"),
    "fast": ("numba", "llvmlite"),
    "ray": ("ray",),
    "bench": ("onnxslim",),
    "openvino": ("openvino",),
    "trt-check": ("tensorrt_rtx",),
}

_EXTRA_OF = {
    module: extra for extra, modules in reversed(MODULES.items()) for module in modules
}


def missing_module(extras: str) -> str:
    """Return the first module of these extras that is not installed, empty if all are.

    ``extras`` are names, separated by commas.
    """
    wanted = (module for extra in extras.split(",") for module in MODULES[extra])
    return next((module for module in wanted if util.find_spec(module) is None), "")


def require_extra(extras: str, user: str) -> None:
    """Raise a MissingExtraError unless these extras are installed; import nothing.

    ``extras`` are names, separated by commas; ``user``, for the message, needs them.
    """
    if module := missing_module(extras):
        raise MissingExtraError(f"{module}, which {user} needs,", extras)


def with_install_hint(error: Exception) -> Exception:
    """Return an error that says what to install, or the error of another cause."""
    if not isinstance(error, ImportError | OSError):
        return error
    # the error may name the module, or something that it needs in its turn: then it is
    # the last one whose own code was running as it was imported
    running = (
        str(frame.f_globals.get("__name__"))
        for frame, _ in traceback.walk_tb(error.__traceback__)
        if frame.f_code.co_name == "<module>"
    )
    named = error.name or "" if isinstance(error, ImportError) else ""
    candidates = [name.partition(".")[0] for name in (*running, named)]
    module = next((name for name in reversed(candidates) if name in _EXTRA_OF), "")
    if not module:
        return error
    if util.find_spec(module) is None:
        return MissingExtraError(module, _EXTRA_OF[module])
    return BrokenPackageError(module, _EXTRA_OF[module], str(error))
