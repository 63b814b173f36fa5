"""``me2e-compress calibrate``."""

import dataclasses
from pathlib import Path
from typing import Annotated

import onnx_ir as ir
import typer
from rich.markup import escape

from me2e_compress import graph, recipe
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.exchange import (
    TABLE_FILES,
    read_foreign,
    write_onnxruntime_table,
    write_tensorrt_cache,
)
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.sample import Part, draw, shard
from me2e_compress.calibration.statistics import Statistics, merge
from me2e_compress.cli.console import console, print_json, progress
from me2e_compress.cli.job import run_on
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import check_folder, check_output
from me2e_compress.errors import FramesError, PreconditionError, RecipeError
from me2e_compress.modules import ModuleMap, map_of
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets import TARGETS, onnxruntime
from me2e_compress.targets.quantized import describe_quantized

_SHOWN = 5


def calibrate(
    model: Annotated[
        Path, typer.Argument(help="the float ONNX file", parser=model_path)
    ],
    frames: Annotated[
        Path | None, typer.Argument(help="the recorded FRAMES; none for --import")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="RANGES.json; SHARD.npz of a shard")
    ] = Path("ranges.json"),
    recipe_name: Annotated[
        str, typer.Option("-r", "--recipe", help="whose passes before int8 are run")
    ] = "exact",
    method: Annotated[
        str,
        typer.Option(
            help="max-min, moving-average[:w], percentile[:p], mse or entropy"
        ),
    ] = "max-min",
    count: Annotated[
        int, typer.Option("-n", "--count", help="frames, drawn in whole scenes")
    ] = 256,
    seed: Annotated[int, typer.Option(min=0, help="of the draw")] = 0,
    module_map: Annotated[
        str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
    ] = None,
    part: Annotated[
        str | None, typer.Option("--shard", help="2/4: only the second of four shards")
    ] = None,
    shards: Annotated[
        list[Path] | None, typer.Option("--merge", help="a SHARD.npz; once for each")
    ] = None,
    foreign: Annotated[
        Path | None,
        typer.Option("--import", help="a TensorRT cache or onnxruntime table"),
    ] = None,
    tensorrt_cache: Annotated[
        Path | None, typer.Option(help="write a TensorRT calibration cache too")
    ] = None,
    onnxruntime_table: Annotated[
        Path | None, typer.Option(help="write onnxruntime's table too: a folder")
    ] = None,
    threads: Annotated[
        int, typer.Option(min=0, help="of onnxruntime; 0 takes all")
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Measure the ranges of every tensor that any scheme, rule set or target needs.

    A run that was killed goes on from OUTPUT.checkpoint; compress takes the
    ranges by --ranges.
    """
    OBSERVERS.parse(method)
    _check_sources(frames, shards, foreign, part)
    if part is not None and (as_json or tensorrt_cache or onnxruntime_table):
        raise FramesError(
            "a shard has no ranges yet: leave --json, --tensorrt-cache and"
            " --onnxruntime-table to --merge"
        )
    checkpoint = output.with_name(output.name + ".checkpoint")
    read = (model, frames, recipe_name, module_map, foreign, *(shards or ()))
    check_output([output, checkpoint, tensorrt_cache], read)
    if onnxruntime_table is not None:
        check_folder(onnxruntime_table, read, TABLE_FILES)
    passes, lowers = _before_int8(recipe.load(recipe_name))
    get = prepare_lowering if lowers else prepare
    ready, tensors = get(model, module_map, passes)
    if foreign is not None:
        found = read_foreign(foreign, graph.digest(ready), tensors)
    elif shards:
        seen = merge([Statistics.load(path) for path in shards])
        found = Ranges.of(seen, OBSERVERS.parse(method))
        found.check(model=graph.digest(ready), tensors=tensors, method=method)
    else:
        chosen = _choose(model, frames or Path(), count, seed, part)
        calibrator = Calibrator(method, threads, checkpoint=checkpoint)
        with progress("calibrate") as advance:
            seen = calibrator.collect(
                ready, tensors, chosen, lambda done, of: advance(done, of, method)
            )
        if part is not None:
            dataclasses.replace(seen, share=chosen.share).save(output)
            console.print(f"{output}: shard {part}, {len(chosen)} frames")
            return
        found = Ranges.of(seen, OBSERVERS.parse(method))
    found.save(output)
    if tensorrt_cache is not None:
        write_tensorrt_cache(found, tensorrt_cache)
    if onnxruntime_table is not None:
        write_onnxruntime_table(found, onnxruntime_table)
    if as_json:
        print_json({**dataclasses.asdict(found), "dead": found.dead})
    else:
        _show(found, output)


def _choose(model: Path, folder: Path, count: int, seed: int, part: str | None) -> Part:
    """Draw frames that fit the model, or one shard of those."""
    recording = CalibrationSet(folder)
    recording.check(graph.load(model))
    chosen = draw(recording, count, seed)
    return chosen if part is None else shard(chosen, *_fraction(part))


def prepare(
    path: Path, module_map: str | None, passes: tuple[Pass, ...]
) -> tuple[ir.Model, tuple[str, ...]]:
    """Give the graph that int8 is put on, and every tensor that may be asked for.

    Raises:
        PreconditionError: the graph is quantized already, or nothing can be int8.
    """
    loaded = graph.load(path)
    if quantized := describe_quantized(loaded):
        raise PreconditionError(
            f"the graph is quantized already: {quantized}; calibrate the float graph"
            " that it was made of"
        )
    modules = map_of(loaded, module_map)
    ready = run_on(loaded, passes, modules)
    graph.infer_shapes(ready)
    tensors = tensors_of_all(ready, modules)
    if not tensors:
        raise PreconditionError(f"{path}: no node can become int8")
    return ready, tensors


def prepare_lowering(
    path: Path, module_map: str | None, passes: tuple[Pass, ...]
) -> tuple[ir.Model, tuple[str, ...]]:
    """Give the quantized graph that is lowered, and the tensors it tells no range of.

    Raises:
        PreconditionError: the graph is not quantized, or tells every range.
    """
    loaded = graph.load(path)
    ready = run_on(loaded, passes, map_of(loaded, module_map))
    graph.infer_shapes(ready)
    tensors = onnxruntime.unranged(ready)
    if not tensors:
        raise PreconditionError(
            f"{path}: it tells every range that {LowerInt8.name} needs: none to measure"
        )
    return ready, tensors


def tensors_of_all(model: ir.Model, modules: ModuleMap) -> tuple[str, ...]:
    """Name what any rule set and target reads when every module is int8."""
    names: dict[str, None] = {}
    for rules in RULE_SETS.usable():
        options = QuantizeInt8(modules=modules.names(), rules=rules)
        plan = options.plan(model, Context(modules))
        for target in map(TARGETS.parse, TARGETS.usable()):
            names |= dict.fromkeys(target.tensors(plan, model))
    return tuple(names)


def _check_sources(
    frames: Path | None,
    shards: list[Path] | None,
    foreign: Path | None,
    part: str | None,
) -> None:
    given = [each is not None for each in (frames, foreign)]
    if sum(given) + bool(shards) != 1:
        raise FramesError(
            "give recorded frames, or shards (--merge), or another tool's cache"
            " (--import): one of the three; ranges are never made up"
        )
    if part is not None and frames is None:
        raise FramesError("--shard is for frames, and none are given")


def _before_int8(passes: tuple[Pass, ...]) -> tuple[tuple[Pass, ...], bool]:
    """Leave out the first pass that reads ranges and the rest; say if it lowers."""
    for at, each in enumerate(passes):
        if isinstance(each, (QuantizeInt8, LowerInt8)):
            return passes[:at], isinstance(each, LowerInt8)
    return passes, False


def _fraction(text: str) -> tuple[int, int]:
    number, slash, count = text.partition("/")
    if not slash or not (number.isdecimal() and count.isdecimal()):
        raise RecipeError(f"--shard is {text!r}; write 2/4 for the second of four")
    return int(number), int(count)


def _show(found: Ranges, output: Path) -> None:
    console.print(
        f"{output}: {len(found.tensors)} tensors, {found.method}, {found.frames} frames"
    )
    worst = sorted(found.outliers.items(), key=lambda item: -item[1])
    outliers = [f"{name} (largest / rms {crest:.0f})" for name, crest in worst]
    for what, names in (
        ("always zero", list(found.dead)),
        ("a few elements make the range", outliers),
    ):
        if names:
            more = f"; and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            line = f"{len(names)} {what}: {'; '.join(names[:_SHOWN])}{more}"
            console.print(escape(line), soft_wrap=True)
