"""The closed loop in figures.

    python benchmarks/measure/closed_loop.py OUT [--workers 2] [--part NAME ...]

Parts: drivers (expert and blind per ability), latency (expert at several latencies),
bytes (the same bytes whatever the workers), throughput (frames per second and core,
memory), slow (CPU s a route but for who drives, and minutes of 220 routes with a policy
of 10 ms), resume (killed and gone on).
Results stay in OUT, so a run that was stopped goes on.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import onnx

from me2e_compress.base.listener import SILENT
from me2e_compress.driving.contract import Answer, Observation, Policy, RouteInfo
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.policies import Driver, driver_named
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.highway.evaluator import Highway
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.evaluators.results import drive_routes
from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores, score
from me2e_compress.simulator.routes import Route, load_routes, pick_routes
from models.driver.expert import Expert
from models.driver.expert.blind import BlindDriver

EXPERT = "models.driver.expert:Expert"
LATENCIES_S = (0.0, 0.05, 0.15, 0.25, 0.45, 0.85)
MODEL_MS = 10.0
SLOW_ROUTES = "44"
SIDE = 192


@dataclass
class Shadow:
    """The expert drives; a model sees the six cameras of every frame for nothing.

    So the routes are as long as a good driver makes them.
    """

    model: OnnxPolicy
    expert: Expert
    privileged: bool = True

    @property
    def needs_images(self) -> bool:
        return self.model.needs_images

    def reset(self, route: RouteInfo) -> None:
        self.model.reset(route)
        self.expert.reset(route)

    def plan(self, observation: Observation) -> npt.NDArray[np.floating]:
        self.model.plan(observation)
        return self.expert.plan(observation)


@dataclass(frozen=True)
class ShadowDriver(Driver):
    """Opens a shadow of a model."""

    name: ClassVar[str] = "shadow"
    path: Path

    def open(self) -> Shadow:
        return Shadow(OnnxPolicy.open(self.path), Expert())


def model_of(products: int, path: Path) -> Path:
    """Write a model that sees six 96x160 images and multiplies matrices."""
    chain = "".join(f"m{k + 1} = MatMul (m{k}, weight)\n" for k in range(products))
    text = f"""<ir_version: 8, opset_import: ["" : 17]>
    slow (float[1, 6, 3, 96, 160] img) => (float[1, 6, 2] plan)
    <int64[2] grid = {{-1, {SIDE}}}, int64[3] as_plan = {{1, 6, 2}},
     int64[1] from = {{0}}, int64[1] to = {{12}}, int64[1] axis = {{0}},
     int64[1] flat = {{-1}}, int64[1] rows = {{{SIDE}}}> {{
        all_rows = Reshape (img, grid)
        m0 = Slice (all_rows, from, rows, axis)
        {chain}
        line = Reshape (m{products}, flat)
        twelve = Slice (line, from, to, axis)
        plan = Reshape (twelve, as_plan)
    }}"""
    model = onnx.parser.parse_model(text)
    mixing = np.linalg.qr(np.random.default_rng(0).normal(size=(SIDE, SIDE)))[0]
    weight = onnx.numpy_helper.from_array(mixing.astype(np.float32), "weight")
    model.graph.initializer.append(weight)
    image = {"mean": [0, 0, 0], "std": [255, 255, 255], "order": "rgb"}
    model.metadata_props.add(key="me2e.image", value=json.dumps(image))
    onnx.save(model, path)
    return path


def evaluate(
    folder: Path,
    driver: Driver,
    routes: tuple[Route, ...],
    workers: int,
    latency_us: int = 0,
) -> tuple[Scores, float]:
    """Drive, and return the scores and the wall-clock seconds."""
    begun = time.perf_counter()
    engine, latency = LocalEngine(workers), FixedLatency(latency_us)
    drives = Drive(latency, routes=routes, set_size=220, engine=engine)
    scores = score(drive_routes(Highway(), driver, drives, folder, SILENT))
    return scores, time.perf_counter() - begun


def log_of(folder: Path) -> list[dict[str, float]]:
    text = folder.with_name(f"{folder.name}.log").read_text("utf-8")
    return [json.loads(line) for line in text.splitlines()]


def bench_drivers(out: Path, workers: int) -> None:
    routes = load_routes()
    columns = ["DS", "room", "SR", *ABILITIES, "DE", "DC", "DE b2d", "DC b2d"]
    print("| driver | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    drivers = {"expert": driver_named(EXPERT)}
    drivers |= {f"blind-{speed}": BlindDriver(speed) for speed in (4, 8, 12)}
    for name, driver in drivers.items():
        found, _ = evaluate(out / name, driver, routes, workers)
        each = [found.each_ability[ability] for ability in ABILITIES]
        shown = (
            *(found.driving_score, found.safety.room_kept, found.success_rate, *each),
            *(found.efficiency, found.comfort),
            *(found.bench2drive_efficiency, found.bench2drive_smoothness),
        )
        cells = [_cell(estimate) for estimate in shown]
        print(f"| {name} | " + " | ".join(cells) + " |")


def _cell(estimate: Estimate) -> str:
    form = ".1f" if estimate.measure.unit == "%" else ".3f"
    return "-" if estimate.value is None else format(estimate.value, form)


def bench_latency(out: Path, workers: int) -> None:
    print("| t (s) | success of the expert (%) | 95 % | DS |\n|---|---|---|---|")
    for seconds in LATENCIES_S:
        folder = out / (f"expert-{seconds:g}s" if seconds else "expert")
        scores, _ = evaluate(
            folder, driver_named(EXPERT), load_routes(), workers, round(seconds * 1e6)
        )
        rate, driving = scores.success_rate, scores.driving_score.value
        print(
            f"| {seconds:g} | {rate.value:.1f} | {rate.low:.1f} to {rate.high:.1f} "
            f"| {driving:.1f} |"
        )


def bench_bytes(out: Path, workers: int) -> None:
    routes = pick_routes(load_routes(), "44")
    folders = [out / f"bytes-{count}" for count in (1, max(2, workers))]
    for folder, count in zip(folders, (1, max(2, workers)), strict=True):
        shutil.rmtree(folder, ignore_errors=True)
        evaluate(folder, driver_named(EXPERT), routes, count, 150_000)
    one, other = (
        {p.relative_to(f): p.read_bytes() for p in f.rglob("*.json")} for f in folders
    )
    print(
        f"{len(one)} files, {sum(map(len, one.values()))} bytes: equal {one == other}"
    )


def bench_throughput(out: Path, _: int) -> None:
    routes = pick_routes(load_routes(), "22")
    light = model_of(1, out / "light.onnx")
    drivers = {
        "blind:8, no cameras": BlindDriver(),
        "expert, no cameras": driver_named(EXPERT),
        "expert and six cameras 96x160": ShadowDriver(light),
    }
    print("| driver | frames/s on one core | MB a worker |\n|---|---|---|")
    for name, driver in drivers.items():
        folder = out / f"throughput-{len(name)}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.with_name(f"{folder.name}.log").unlink(missing_ok=True)
        evaluate(folder, driver, routes, 1)
        log = log_of(folder)
        frames, seconds = (
            sum(row[key] for row in log) for key in ("frames", "seconds")
        )
        memory = max(row["memory_mb"] for row in log)
        print(f"| {name} | {frames / seconds:.0f} | {memory:.0f} |")


@dataclass
class Timed:
    """Sees the cameras of every frame, and counts the CPU time of who drives."""

    policy: Policy
    needs_images: bool = True
    privileged: bool = True
    seconds: float = 0.0

    def reset(self, route: RouteInfo) -> None:
        self.policy.reset(route)

    def plan(self, observation: Observation) -> Answer:
        begun = time.process_time()
        answer = self.policy.plan(observation)
        self.seconds += time.process_time() - begun
        return answer


def bench_slow(_: Path, __: int) -> None:
    """Add a policy of 10 CPU ms to what all else of a good driver's routes takes."""
    routes = pick_routes(load_routes(), SLOW_ROUTES)
    timed, frames, decisions = Timed(Expert()), 0, 0
    begun = time.process_time()
    for route in routes:
        episode = drive(route, timed, Drive())
        frames += len(episode.frames)
        decisions += len(episode.decisions)
    own = time.process_time() - begun - timed.seconds
    count, cores = len(routes), 2
    minutes = [
        220 / count * seconds / cores / 60
        for seconds in (own, MODEL_MS / 1e3 * decisions)
    ]
    print(
        f"{count} routes, {frames / count:.0f} frames a route: {own / count:.2f} CPU s"
        f" a route and {1e3 * own / frames:.2f} CPU ms a frame but for who drives\n"
        f"220 routes on {cores} cores: {minutes[0]:.1f} min, and {minutes[1]:.1f} of a"
        f" policy of {MODEL_MS:g} CPU ms"
    )


def bench_resume(out: Path, workers: int) -> None:
    folder, whole = out / "resume", out / "whole"
    for path in (folder, whole):
        shutil.rmtree(path, ignore_errors=True)
        path.with_name(f"{path.name}.log").unlink(missing_ok=True)
    words = [str(Path(__file__)), str(out), "--workers", str(workers), "--drive-resume"]
    with subprocess.Popen([sys.executable, *words], start_new_session=True) as running:
        while len(list(folder.glob("routes/*.json"))) < 10:
            time.sleep(0.05)
        os.killpg(running.pid, signal.SIGKILL)
    before = len(list(folder.glob("routes/*.json")))
    routes = pick_routes(load_routes(), "44")
    evaluate(folder, BlindDriver(), routes, workers)
    evaluate(whole, BlindDriver(), routes, 1)
    driven = [row["route"] for row in log_of(folder)]
    same = all(
        (folder / p.relative_to(whole)).read_bytes() == p.read_bytes()
        for p in whole.rglob("*.json")
    )
    print(
        f"killed after {before} of {len(routes)}; {len(driven)} drives in all, "
        f"{len(set(driven))} routes, same bytes as undisturbed: {same}"
    )


PARTS = {
    "drivers": bench_drivers,
    "latency": bench_latency,
    "bytes": bench_bytes,
    "throughput": bench_throughput,
    "slow": bench_slow,
    "resume": bench_resume,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--part", action="append", choices=PARTS)
    parser.add_argument("--drive-resume", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.drive_resume:
        routes = pick_routes(load_routes(), "44")
        evaluate(given.out / "resume", BlindDriver(), routes, given.workers)
        return
    for name in given.part or PARTS:
        print(f"\n## {name}\n")
        PARTS[name](given.out, given.workers)


if __name__ == "__main__":
    main()
