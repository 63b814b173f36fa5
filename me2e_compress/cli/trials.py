"""What ``sensitivity`` and ``search`` have in common."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress import graph, recipe
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.sample import draw
from me2e_compress.cli.commands.calibrate import prepare
from me2e_compress.cli.console import progress
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import Given, check_output
from me2e_compress.modules import map_of
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.sensitivity import Drive, Int8Choice, Trials, write_recipe
from me2e_compress.targets import TARGETS

Model = Annotated[Path, typer.Argument(help="the float ONNX file", parser=model_path)]
Recording = Annotated[Path, typer.Argument(help="the recorded FRAMES")]
Output = Annotated[Path, typer.Option("-o", "--output", help="the RECIPE.toml")]
Scheme = Annotated[str, typer.Option(help="modules that may be int8")]
Rules = Annotated[str, typer.Option(help="of the int8 plans: paper or tensorrt")]
Saved = Annotated[
    Path | None, typer.Option("--ranges", help="RANGES.json instead of calibrating")
]
Map = Annotated[
    str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
]
Count = Annotated[int, typer.Option("-n", "--count", help="frames to judge on")]
Threads = Annotated[int, typer.Option(min=0, help="of onnxruntime; 0 takes all")]
Json = Annotated[bool, typer.Option("--json", help="for programs")]


@dataclasses.dataclass(frozen=True)
class Setting:
    """What both commands are told."""

    model: Path
    frames: Path
    scheme: str
    rules: str
    target: str
    ranges: Path | None
    module_map: str | None
    count: int
    threads: int

    def check_output(self, output: Path, *inputs: Given) -> None:
        """Refuse, before any work, a recipe that could not be written or does harm."""
        read = (self.model, self.frames, self.ranges, self.module_map, *inputs)
        overrides = output.with_name(output.stem + ".overrides.toml")
        check_output([output, overrides], read)

    def trials(self, drive: Drive | None = None) -> tuple[Trials, tuple[str, ...]]:
        """Prepare the graph, calibrate once, and name the modules to try."""
        rules, target = RULE_SETS.parse(self.rules), TARGETS.parse(self.target)
        recording = CalibrationSet(self.frames)
        loaded = graph.load(self.model)
        recording.check(loaded)
        modules = map_of(loaded, self.module_map)
        scheme = QuantScheme.named(self.scheme, modules)
        ready, tensors = prepare(self.model, self.module_map, recipe.load("exact"))
        if self.ranges is not None:
            ranges = Ranges.load(self.ranges)
            ranges.check(
                model=graph.digest(ready), tensors=tensors, method=ranges.method
            )
        else:
            with progress("calibrate") as advance:
                ranges = Calibrator(threads=self.threads).run(
                    ready, tensors, recording, lambda done, of: advance(done, of, "")
                )
        judged = draw(recording, self.count, 0)
        made = Trials(
            ready,
            modules,
            rules,
            target,
            ranges,
            judged,
            drive=drive,
            threads=self.threads,
        )
        return made, scheme.modules

    def write(self, output: Path, choice: Int8Choice) -> str:
        """Write the recipe, and give a line that says where it is."""
        before = tuple(each.name for each in recipe.load("exact"))
        overrides = write_recipe(output, choice, before, self.rules, self.target)
        listed = ", ".join(choice.modules) or "no module"
        more = f", {len(choice.floats)} of their nodes in float" if overrides else ""
        return f"{output}: int8 in {listed}{more}"
