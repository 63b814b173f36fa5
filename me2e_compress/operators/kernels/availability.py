"""Find out whether kernels run here, and why not."""

from importlib.util import find_spec

from me2e_compress.operators.kernels import trampoline


def why_not() -> str | None:
    """Return why this machine runs no kernels; None if it does.

    Nothing is imported for this check: Numba itself may still fail to load.
    """
    if reason := trampoline.why_not():
        return reason
    for package in ("numba", "llvmlite"):
        if find_spec(package) is None:
            return f"{package} is not installed: pip install 'me2e-compress[fast]'"
    try:
        trampoline.trampoline()
    except OSError as error:
        return f"neither the cache folder nor memory may hold code that runs: {error}"
    return None
