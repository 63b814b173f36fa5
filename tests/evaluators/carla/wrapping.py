"""Options of the real-time wrapper around the numbered agent."""

import json
from pathlib import Path

from tests.evaluators.carla.small_leaderboard import written

NUMBERED = Path(__file__).with_name("numbered_agent.py")


def config(folder: Path, /, **options: object) -> str:
    """Write the wrapper's options; the wrapped agent saves below the folder."""
    options = {"agent": str(NUMBERED), "config": str(folder / "saved"), **options}
    lines = [f"{key} = {json.dumps(value)}" for key, value in options.items()]
    return str(written(folder / "wrap.toml", "\n".join(lines)))
