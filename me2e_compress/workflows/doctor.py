"""Report what this machine can do, and what to install for the rest."""

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import os
import platform

import onnxruntime
import psutil
import pynvml

from me2e_compress.manager.report import versions
from me2e_compress.operators.kernels import KERNELS, why_not
from me2e_compress.runtime.energy.energy_counter import EnergyRecording, open_counter
from me2e_compress.runtime.energy.energy_result import Absent
from me2e_compress.workflows.result import Result, Table, table

_EXTRAS = (
    ("highway_env", "highway", "drive models in closed loop"),
    ("tensorrt_rtx", "trt-check", "parse and build for TensorRT without a GPU"),
    ("onnxslim", "bench", "compare with onnxslim in the benchmarks"),
)


@dataclasses.dataclass(frozen=True)
class Checkup:
    """One thing a machine can do, or, where `found` is None, how to make it do so."""

    what: str
    found: str | None
    advice: str = ""


@dataclasses.dataclass(frozen=True, repr=False)
class DoctorResult(Result):
    """Everything that was looked for."""

    checkups: tuple[Checkup, ...]

    @property
    def headline(self) -> str:
        """The number of things found."""
        found = sum(each.found is not None for each in self.checkups)
        return f"{found} of {len(self.checkups)} things found"

    def lines(self) -> tuple[str, ...]:
        """Return no line: the table says everything."""
        return ()

    def tables(self) -> tuple[Table, ...]:
        """Return what was found, and what to do for the rest."""
        rows = [(each.what, each.found or "no", each.advice) for each in self.checkups]
        return (table("This machine", ("what", "found", "to have it"), rows, words=3),)


def doctor() -> DoctorResult:
    """Look for everything that the toolkit can make use of."""
    return DoctorResult((*_machine(), *_packages(), _kernels(), _gpu(), _energy()))


def _machine() -> list[Checkup]:
    memory = psutil.virtual_memory().total / 2**30
    enough = "" if memory >= 6 else "VAD-tiny needs 6 GiB to calibrate"
    return [
        Checkup("cores", str(os.cpu_count())),
        Checkup("memory", f"{memory:.1f} GiB", enough),
        Checkup("platform", platform.platform()),
        Checkup("onnxruntime on", ", ".join(onnxruntime.get_available_providers())),
    ]


def _packages() -> list[Checkup]:
    found = [Checkup(name, version) for name, version in versions().items()]
    for module, extra, purpose in _EXTRAS:
        if importlib.util.find_spec(module) is None:
            advice = f"{purpose}: pip install 'me2e-compress[{extra}]'"
            found.append(Checkup(module, None, advice))
        else:
            found.append(Checkup(module, _version(module)))
    return found


def _version(module: str) -> str:
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(module.replace("_", "-"))
    return "of unknown version"


def _kernels() -> Checkup:
    what = "compiled kernels"
    if reason := why_not():
        return Checkup(what, None, f"fused operators run as their bodies: {reason}")
    return Checkup(what, ", ".join(each.op_type for each in KERNELS))


def _energy() -> Checkup:
    found = open_counter()
    if isinstance(found, Absent):
        advice = f"joules are not measured here: {found.reason}; docs/energy.md"
        return Checkup("energy counter", None, advice)
    if isinstance(found, EnergyRecording):
        return Checkup("energy counter", found.counter)
    with contextlib.closing(found):
        what = f"{found.counter} of {found.device}: {found.scope}"
        return Checkup("energy counter", what)


def _gpu() -> Checkup:
    # a driver without a GPU fails later than a missing driver
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        return Checkup("NVIDIA GPU", None, f"no GPU is used ({error})")
    try:
        handle = pynvml.nvmlDeviceGetHandleByIndex(0)
        return Checkup("NVIDIA GPU", str(pynvml.nvmlDeviceGetName(handle)))
    except pynvml.NVMLError as error:
        return Checkup("NVIDIA GPU", None, f"the driver answers: {error}")
    finally:
        pynvml.nvmlShutdown()
