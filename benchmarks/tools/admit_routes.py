"""Make a set of routes as the one that ships was made.

    python -m benchmarks.tools.admit_routes -o ROUTES.json --seed 220202 --workers 2

Proposes routes of every type until so many are admitted by `models.driver.admission`,
and goes on where it was killed. Prints, as JSON, how many were admitted and why others
were refused; `benchmarks.measure.road --admission` counts the reasons.
`second_road.json` is what it printed of the set that ships.
"""

import argparse
import json
from pathlib import Path

from me2e_compress.simulator.routes import SCENARIO_ABILITIES
from models.driver.admission import VARIANTS, make_routes


def main() -> None:
    """Read what is asked for, make the set and print its counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", type=int, default=VARIANTS, help="of each type")
    parser.add_argument("--types", default=",".join(SCENARIO_ABILITIES))
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    types = given.types.split(",")
    harvests = make_routes(
        given.output, given.seed, types, given.variants, given.workers
    )
    scenarios = [
        {
            "scenario": one.scenario,
            "admitted": len(one.routes),
            "tried": one.tried,
            "refusals": one.refusals,
        }
        for one in harvests
    ]
    counts = {
        "admitted": sum(len(one.routes) for one in harvests),
        "tried": sum(one.tried for one in harvests),
    }
    print(json.dumps({**counts, "scenarios": scenarios}, indent=2))


if __name__ == "__main__":
    main()
