"""``me2e-compress doctor``."""

import dataclasses
import importlib.metadata
import importlib.util
import os
import platform
from typing import Annotated

import onnxruntime
import psutil
import pynvml
import typer

from me2e_compress.cli.console import console, print_json, table
from me2e_compress.manager.report import versions

_EXTRAS = (
    ("torch", "zoo", "export the reference stacks, train the driver"),
    ("highway_env", "highway", "drive models in closed loop"),
    ("tensorrt_rtx", "trt-check", "parse and build for TensorRT without a GPU"),
    ("onnxslim", "bench", "compare with onnxslim in the benchmarks"),
)


@dataclasses.dataclass(frozen=True)
class Checkup:
    """One thing a machine can or cannot do.

    Attributes:
        what: the ability.
        found: what is there, or None.
        advice: what to do to have it; empty where it is there.
    """

    what: str
    found: str | None
    advice: str = ""


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Say what this machine can do, and what to install for the rest."""
    findings = [*_machine(), *_packages(), _gpu()]
    if as_json:
        print_json([dataclasses.asdict(finding) for finding in findings])
        return
    shown = table("This machine", "what", "found", "to have it", left=3)
    for finding in findings:
        shown.add_row(finding.what, finding.found or "[red]no[/red]", finding.advice)
    console.print(shown)


def _machine() -> list[Checkup]:
    memory = psutil.virtual_memory().total / 2**30
    enough = "" if memory >= 6 else "VAD-tiny wants 6 GiB to calibrate"
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
            name = module.replace("_", "-")
            found.append(Checkup(module, importlib.metadata.version(name)))
    return found


def _gpu() -> Checkup:
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        return Checkup("NVIDIA GPU", None, f"energy is not measured here ({error})")
    try:
        handle = pynvml.nvmlDeviceGetHandleByIndex(0)
        return Checkup("NVIDIA GPU", str(pynvml.nvmlDeviceGetName(handle)))
    except pynvml.NVMLError as error:
        return Checkup("NVIDIA GPU", None, f"the driver answers: {error}")
    finally:
        pynvml.nvmlShutdown()
