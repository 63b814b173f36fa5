"""Read state dicts of other programs as tensors by name, without running code."""

import hashlib
import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from me2e_compress.base.documents import MalformedError, check_regular, reading
from me2e_compress.base.errors import GraphError

if TYPE_CHECKING:
    from torch import Tensor

WRAPPERS = ("state_dict", "model_state_dict", "model")
"""Keys under which a checkpoint holds its tensors: the first of mmcv and PyTorch
Lightning."""

PREFIXES = ("module.", "model.", "_orig_mod.")
"""Prefixes of names from DataParallel, Lightning modules and ``torch.compile``."""

EPOCHS = ("epoch",)
ITERATIONS = ("iter", "iteration", "global_step")
"""Keys of mmcv's and Lightning's counters, in ``meta`` or beside the tensors."""

SAFETENSORS = ".safetensors"

_BROKEN = (
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    OverflowError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
)
"""What torch's reader raises, besides its own refusal, on foreign or broken files."""

_NAMED = 5


@dataclass(frozen=True, eq=False)
class StateDict:
    """Tensors of a checkpoint by name, without the prefixes of wrappers.

    ``epoch`` and ``iteration`` are as stated in the file; ``sha256`` is lower-case hex.
    """

    path: Path
    sha256: str
    tensors: Mapping[str, "Tensor"]
    epoch: int | None = None
    iteration: int | None = None


def read_state_dict(path: Path) -> StateDict:
    """Read the tensors of a checkpoint and ignore everything else in it.

    ``path`` is a file of ``torch.save``, zipped or not, or ``.safetensors``, with
    tensors by name, or with a dictionary of them under one of `WRAPPERS`.

    Raises:
        GraphError: the file cannot be read, is truncated or broken, would run code, or
            holds no tensors by name.
    """
    with reading(path, GraphError, "not read as weights"):
        # Hash the file before parsing it
        check_regular(path)
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        named = path.suffix == SAFETENSORS
        whole = _from_safetensors(path) if named else _from_torch(path)
        tensors = _without_prefixes(_tensors(whole))
        epoch, iteration = (_count(whole, keys) for keys in (EPOCHS, ITERATIONS))
        return StateDict(path, sha256, tensors, epoch, iteration)


def _from_torch(path: Path) -> object:
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # how old the file's form is
            found: object = torch.load(
                path,
                map_location="cpu",
                weights_only=True,
                mmap=zipfile.is_zipfile(path),
            )
    except pickle.UnpicklingError as error:
        raise MalformedError(_refusal(str(error))) from error
    except _BROKEN as error:
        first = (str(error).splitlines() or ["it ends too early"])[0]
        raise MalformedError(f"cut or broken ({first[:120]})") from error
    return found


def _refusal(said: str) -> str:
    asked = re.search(r"GLOBAL ([\w.]+)", said)
    if asked is None:
        return "neither a file of torch.save nor .safetensors"
    return (
        f"it asks for {asked[1]}, which may run code: only tensors and plain values are"
        " read"
    )


def _from_safetensors(path: Path) -> object:
    import safetensors

    try:
        with safetensors.safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            said = file.metadata() or {}
    except safetensors.SafetensorError as error:
        raise MalformedError(f"cut or broken ({error})") from error
    meta = {key: int(text) for key, text in said.items() if text.isdecimal()}
    return {"state_dict": tensors, "meta": meta}


def _tensors(whole: object) -> Mapping[Any, Any]:
    """Return the content under the wrapper's key, or everything."""
    if not isinstance(whole, Mapping):
        raise MalformedError(f"it holds a {type(whole).__name__}, not tensors by name")
    # Unwrap the only known key
    held = [key for key in WRAPPERS if isinstance(whole.get(key), Mapping)]
    if len(held) > 1:
        raise MalformedError(f"it holds {' and '.join(held)}: keep one")
    found: Mapping[Any, Any] = whole[held[0]] if held else whole
    # Everything left must be tensors by name
    wrong = next((k for k in found if not _is_tensor(k, found[k])), None)
    if wrong is not None and not held:
        keys = [str(key) for key in whole]
        more = ", ..." if len(keys) > _NAMED else ""
        raise MalformedError(
            f"no state dict: it holds {', '.join(keys[:_NAMED])}{more}"
        )
    if wrong is not None:
        kind = type(found[wrong]).__name__
        raise MalformedError(f"{held[0]}: {wrong!r} is a {kind}, not a tensor")
    return found


def _is_tensor(name: object, value: object) -> bool:
    import torch

    return isinstance(name, str) and isinstance(value, torch.Tensor)


def _without_prefixes(tensors: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
    """Return the tensors by bare names, which must be unique."""
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        bare = name
        while bare.startswith(PREFIXES):
            bare = bare.partition(".")[2]
        if bare in found:
            raise MalformedError(f"it holds {bare} twice, once as {name}")
        found[bare] = tensor
    return found


def _count(whole: object, keys: tuple[str, ...]) -> int | None:
    """Return the first integer under any of the keys, in ``meta`` or next to it."""
    if not isinstance(whole, Mapping):
        return None
    for place in (whole.get("meta"), whole):
        for key in keys:
            value = place.get(key) if isinstance(place, Mapping) else None
            if isinstance(value, int) and not isinstance(value, bool):
                return value
    return None
