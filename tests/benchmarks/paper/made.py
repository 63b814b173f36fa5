"""Finished drives of the paper's study that nobody drove: numbers from a seed."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.paper.drives import FILE, Int8Counts, KeptFacts, ModelFacts
from me2e_compress.metrics.episode import InfractionKind
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.simulator.routes import Route
from me2e_compress.study import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.workload import frames_per_decision

LOST = {"minus-map": 60.0, "minus-motion": 10.0, "full": 6.0, "prediction": 3.0}
KINDS = (InfractionKind.COLLISION_VEHICLE, InfractionKind.COLLISION_LAYOUT)


def write_records(study: Study, folder: Path) -> Path:
    """Write a record for every drive of a study, and facts for every variant."""
    for condition in study.conditions:
        late = frames_per_decision(study, condition) - 1
        for variant in study.driven_under(condition):
            name = variant.name
            lost = 0.2 * late**2 + sum(LOST[k] for k in LOST if k in name)
            routes = _routes(study, lost, late, name)
            made_by = {"set_size": study.set_size, "routes_sha256": "0", "of": name}
            record = DriveRecord(name, condition.name, routes, made_by)
            record.save(folder / f"{name}.{condition.name}.jsonl")
    facts = tuple(_fact(each.name) for each in study.variants)
    KeptFacts(20.0, facts, "none").save(folder / FILE)
    return folder


def _routes(
    study: Study, lost: float, late: int, name: str
) -> tuple[RouteSummary, ...]:
    made = []
    for number, route in enumerate(study.routes):
        random = np.random.default_rng([number, late, len(name)])
        hit = random.random() < lost / 100
        score = float(np.clip(100 - lost * random.random() * 2, 0, 100))
        assert isinstance(route, Route)
        kind = KINDS[int(random.random() < (0.6 if "map" in name else 0.2))]
        made.append(
            RouteSummary(
                route.id,
                route.scenario,
                round(score * (0.6 if hit else 1.0), 3),
                round(score, 2),
                not hit,
                "collision" if hit else "completed",
                ((kind.value, 5_000_000, "car 3"),) if hit else (),
                round(150 + 2.0 * late + random.normal(0, 20), 3),
                round(float(np.clip(random.normal(0.8 - late / 50, 0.1), 0, 1)), 3),
                20_000_000,
                400 // (late + 1),
                (50_000 * (late + 1),) * 4,
                50_000 * (late + 1) * (400 // (late + 1)),
                bench2drive_efficiency=round(130 + random.normal(0, 20), 3),
                bench2drive_smoothness=0.4 + number / 100 if late else 0.2,
            )
        )
    return tuple(made)


def _whole(values: npt.NDArray[np.float64]) -> tuple[int, ...]:
    return tuple(values.astype(int).tolist())


def _fact(name: str) -> ModelFacts:
    random = np.random.default_rng(len(name))
    int8 = Int8Counts(80, 60, 40) if name in ("full", "prediction") else None
    if "feature-ext" in name:
        int8 = Int8Counts(30, 31, 31)
    slow = 430_000 - 900 * (int8.operators if int8 else 0)
    samples = slow * random.lognormal(0.0, 0.05, 300)
    modules = {
        part: tuple(
            (share * 430_000 * random.lognormal(0, 0.1, 60)).astype(int).tolist()
        )
        for part, share in (("backbone", 0.5), ("map", 0.3), ("planner", 0.2))
    }
    return ModelFacts(
        name,
        "0" * 64,
        "",
        6_683_696 - 30_000 * len(name),
        1_513_999 - 10_000 * name.count("-"),
        835_967_776 - 10**7 * name.count("-"),
        int8,
        _whole(samples),
        modules if name == "float" else {},
        modelled_j=0.004 - 1e-5 * (int8.operators if int8 else 0),
    )
