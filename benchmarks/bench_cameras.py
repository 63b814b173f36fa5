"""How long six images take: ground only, typical and crowded; the texture's cost.

    python benchmarks/bench_cameras.py [--rounds 200]

Milliseconds of processor time for all six cameras on one thread: the median over the
rounds, and the best. Processor time, so that a busy machine disturbs little.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from me2e_compress.simulator.cameras import (
    CameraRig,
    Cameras,
    Weather,
    paint_texture,
)
from me2e_compress.simulator.plane_geometry import Lane, LaneMarking, Roadmap
from me2e_compress.simulator.scene import DIMENSIONS, Actor, ActorKind, Ego, Scene

LANE_M = 4.0
LENGTH_M = 150.0


def road() -> Roadmap:
    """Three lanes and a crossing of two."""
    lanes = []
    for i in range(3):
        left = LaneMarking.SOLID if i == 0 else LaneMarking.DASHED
        right = LaneMarking.SOLID if i == 2 else LaneMarking.NONE
        x = np.arange(-80.0, LENGTH_M + 81.0, 2.0)
        centre = np.stack([x, np.full_like(x, (1 - i) * LANE_M)], axis=1)
        lanes.append(Lane(f"w>e:{i}", centre, LANE_M, left, right, 13.9))
    for i in range(2):
        y = np.arange(-80.0, 81.0, 2.0)
        centre = np.stack([np.full_like(y, 60.0 + i * LANE_M), y], axis=1)
        none = LaneMarking.NONE
        lanes.append(Lane(f"s>n:{i}", centre, LANE_M, none, none, 13.9))
    line = ((56.0, -6.0), (56.0, 6.0))
    zebra = ((51.0, -6.0), (51.0, 6.0), (54.0, 6.0), (54.0, -6.0))
    return Roadmap(tuple(lanes), (line,), (zebra,))


def scene(boxes: int) -> Scene:
    """Cars in three lanes around the ego, the nearest first."""
    places = [(12.0 * row, lane) for row in range(-4, 5) for lane in (4.0, 0.0, -4.0)]
    places = [(x + 1.5 * (y > 0), y) for x, y in places if (x, y) != (0.0, 0.0)]
    places.sort(key=lambda place: abs(place[0]) + abs(place[1]))
    size = DIMENSIONS[ActorKind.CAR]
    actors = tuple(
        Actor(i, ActorKind.CAR, 30.0 + x, y, 0.0, 8.0, *size, i % 3 == 0, i % 3 - 1)
        for i, (x, y) in enumerate(places[:boxes])
    )
    ego = Ego(30.0, 0.0, 0.02, 8.0, 0.0, 0.0, 0.0, 0.0, 4.6, 1.95)
    return Scene(0, ego, actors, ())


def milliseconds(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median and best processor time of a call."""
    for _ in range(5):
        work()
    times = []
    for _ in range(rounds):
        start = time.process_time_ns()
        work()
        times.append((time.process_time_ns() - start) / 1e6)
    return statistics.median(times), min(times)


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    rounds = parser.parse_args().rounds
    route = np.stack([np.arange(LENGTH_M + 1), np.zeros(int(LENGTH_M) + 1)], axis=1)
    diagonal = route[:, :1] * np.full((1, 2), 0.5**0.5)
    for name, line in (("straight", route), ("diagonal", diagonal)):
        texture = paint_texture(road(), line)
        median, best = milliseconds(partial(paint_texture, road(), line), 5)
        rasters = (texture.classes, *texture.levels)
        size = f"{sum(each.nbytes for each in rasters) / 1e6:.1f} MB"
        print(f"texture {name:9} {median:7.1f} ms (best {best:.1f}), {size}")
    texture = paint_texture(road(), route)
    storm = Weather(fog_m=60.0, night=0.5, rain=0.7, noise=4.0)
    for height, width in ((96, 160), (128, 224)):
        rig = CameraRig(height, width)
        clear, stormy = Cameras(texture, rig), Cameras(texture, rig, storm)
        for name, work, boxes in (
            ("ground only", clear.render, 0),
            ("typical", clear.render, 5),
            ("crowded", clear.render, 22),
            ("typical, storm", stormy.render, 5),
            ("class raster", clear.classes, 5),
        ):
            median, best = milliseconds(partial(work, scene(boxes)), rounds)
            size = f"{height}x{width}"
            print(f"{size:8} {name:15} {boxes:2} boxes {median:6.2f} ms ({best:.2f})")


if __name__ == "__main__":
    main()
