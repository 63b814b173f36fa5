"""What the paper's ten ablations take from a graph, beside what the paper measured.

    python -m benchmarks.measure.ablations OUT
    python -m benchmarks.measure.ablations OUT --stacks uniad-tiny,vad-tiny,highway

Exports each stack into OUT unless it is there, and runs every recipe of its schemes.
Parameters, MACs, nodes and bytes of weights are held against what the recipe ``exact``
makes of the same file, so that they are the ablation's alone; parameters are also held
against the ledger of the published stacks. The driver ``highway`` has no
published ablations: its rows stand beside UniAD's of the same modules.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import onnx_ir as ir

from benchmarks.paper.published import (
    MODULES_AWAY,
    MODULES_AWAY_OF_VAD,
    PublishedDrive,
)
from benchmarks.subjects.subjects import write_source
from me2e_compress import graph
from me2e_compress.base.errors import Me2eError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.inspect import weigh
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context, Pass
from me2e_compress.shipped.drivers import frames_of

LEDGER_M = {
    "uniad-scheme-1": 14.455,
    "uniad-scheme-2": 28.995 - 10.240 - 6.453 - 0.888 - 0.530 - 0.008 + 2.372,
    "uniad-scheme-3": 13.770 - 0.394,
    "vad-scheme-8": 4.07,
    "vad-scheme-9": 2.216 - 0.099 + 0.853,
}
"""Millions of parameters by the published sizes of the modules, what inference never
reads left out; of those schemes whose modules do not lie in each other."""
COMMON = 2
"""Passes that every recipe begins with: import and folding."""
HEAD = """\
| stack | recipe | M parameters less | by the ledger | GMACs less | of all \
| nodes less | MB less | the paper's scheme | its FPS | its J a frame |
|---|---|---:|---:|---:|---:|---:|---:|---|---|---|"""


@dataclass(frozen=True)
class Weight:
    """What a graph holds."""

    parameters: int
    macs: int
    nodes: int
    size_bytes: int


@dataclass(frozen=True)
class Stack:
    """A stack, and its recipes with the paper's row for each."""

    preset: str
    recipes: Mapping[str, str]
    paper: Mapping[str, PublishedDrive]


def _named(prefix: str, modules: Sequence[str], first: int) -> dict[str, str]:
    return {f"{prefix}-{first + at}": each for at, each in enumerate(modules)}


SCHEMES = [name for name in MODULES_AWAY if name != "float"]
STACKS = {
    "uniad-tiny": Stack(
        "uniad",
        _named(
            "uniad-scheme",
            [
                *("minus-occ", "minus-map", "minus-motion", "minus-map-motion"),
                *("minus-occ-motion", "minus-occ-map", "minus-occ-map-motion"),
            ],
            1,
        ),
        MODULES_AWAY,
    ),
    "vad-tiny": Stack(
        "vad",
        _named("vad-scheme", ["map", "motion", "map-motion"], 8),
        MODULES_AWAY_OF_VAD,
    ),
    "highway": Stack("highway", {name: name for name in SCHEMES}, MODULES_AWAY),
}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--stacks", default=",".join(STACKS))
    given = parser.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    try:
        print(HEAD, flush=True)
        for name in given.stacks.split(","):
            for line in rows(name, given.out):
                print(line, flush=True)
    except Me2eError as error:
        sys.exit(f"ablations: {error}")


def rows(name: str, out: Path) -> Iterable[str]:
    """Run the recipes of a stack; yield a row each.

    Raises:
        Me2eError: a recipe fails.
    """
    stack, source = STACKS[name], out / f"{name}.onnx"
    if not source.is_file():
        write_source(name, source)
    frames = frames_of(source)
    recording = None if frames is None else CalibrationSet(frames)
    context = Context(ModuleMap.load(stack.preset), recording)
    folded = run(graph.load(source), recipe.load("exact")[:COMMON], context)
    whole = made(folded, "exact", context)
    for number, (wanted, modules) in enumerate(stack.recipes.items(), 1):
        left = made(folded, wanted, context)
        scheme = wanted.removeprefix("uniad-scheme-").removeprefix("vad-scheme-")
        label = f"({scheme})" if scheme.isdigit() else f"({number}) of UniAD"
        cells = (
            *(name, f"`{wanted}`"),
            *against(whole, left, LEDGER_M.get(wanted)),
            label,
            *beside(stack.paper["float"], stack.paper[modules]),
        )
        yield f"| {' | '.join(cells)} |"


def run(model: ir.Model, passes: tuple[Pass, ...], context: Context) -> ir.Model:
    return PassManager(passes, verify_frames=0).run(model, context).model


def made(folded: ir.Model, name: str, context: Context) -> Weight:
    """Run the rest of a recipe and weigh what it made."""
    model = run(folded.clone(), recipe.load(name)[COMMON:], context)
    found = weigh(model, context.modules)
    return Weight(
        sum(each.parameters for each in found),
        sum(each.macs or 0 for each in found),
        sum(each.nodes for each in found),
        sum(each.weight_bytes for each in found),
    )


def against(whole: Weight, left: Weight, ledger_m: float | None) -> Iterable[str]:
    """Say what went."""
    gone = whole.macs - left.macs
    yield f"{(whole.parameters - left.parameters) / 1e6:.3f}"
    yield "" if ledger_m is None else f"{ledger_m:.3f}"
    yield f"{gone / 1e9:.2f}"
    yield f"{gone / whole.macs:.1%}"
    yield f"{whole.nodes - left.nodes:,}"
    yield f"{(whole.size_bytes - left.size_bytes) / 1e6:.1f}"


def beside(before: PublishedDrive, after: PublishedDrive) -> Iterable[str]:
    """Say what the paper measured: frames a second and joules a frame, and by how much.

    The difference is of 1 / FPS, the time of a frame, and of joules.
    """
    yield f"{before.fps:g} → {after.fps:g} (time {before.fps / after.fps - 1:+.1%})"
    if before.joules is None or after.joules is None:
        yield ""
    else:
        change = after.joules / before.joules - 1
        yield f"{before.joules:g} → {after.joules:g} ({change:+.1%})"


if __name__ == "__main__":
    main()
