"""The small course in a process of its own: `python -m models.tests.driver.small`."""

import sys
from dataclasses import replace
from pathlib import Path

from models.driver.course import run
from models.driver.curriculum import SMALL, SMALL_LATENCY, Course, Round

WORKERS = 2


def saving_often(each: Round) -> Round:
    """The same weights, a checkpoint a step."""
    stages = tuple(replace(one, save_every=1) for one in each.trainings)
    return replace(each, trainings=stages)


def course_of(rounds: int) -> Course:
    return replace(SMALL, rounds=tuple(map(saving_often, SMALL.rounds[:rounds])))


if __name__ == "__main__":
    course = course_of(int(sys.argv[2]))
    run(course, Path(sys.argv[1]), WORKERS, latency=SMALL_LATENCY)
