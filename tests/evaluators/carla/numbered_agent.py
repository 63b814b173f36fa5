"""An agent like Bench2DriveZoo's: its n-th decision steers n thousandths."""

import json
from pathlib import Path
from typing import Any

from carla import VehicleControl  # type: ignore
from leaderboard.autoagents.autonomous_agent import (  # type: ignore
    AutonomousAgent,
    Track,
)

LEAD = 0.001


def get_entry_point() -> str:
    return "NumberedAgent"


class NumberedAgent(AutonomousAgent):  # type: ignore[misc]
    def setup(self, path_to_conf_file: str) -> None:
        self.track = Track.SENSORS
        self.conf = path_to_conf_file
        folder, _, self.save_name = path_to_conf_file.partition("+")
        self.save_path = Path(folder) / self.save_name
        self.save_path.mkdir(parents=True, exist_ok=False)
        self.step, self.decisions, self.ticks = -1, 0, 0
        self.metric_info: dict[int, Any] = {}
        self.fails_at = -1
        self.gone = False

    def sensors(self) -> list[dict[str, Any]]:
        return [{"type": "sensor.speedometer", "reading_frequency": 20, "id": "SPEED"}]

    def tick(self, input_data: Any) -> dict[str, Any]:
        self.step += 1
        self.ticks += 1
        return {"speed": input_data["SPEED"][1]["speed"]}

    def run_step(self, input_data: Any, timestamp: float) -> Any:
        self.tick(input_data)
        if self.decisions == self.fails_at:
            raise RuntimeError("CUDA out of memory")
        self.decisions += 1
        self.metric_info[self.step] = self.get_metric_info()
        control = VehicleControl()
        control.throttle, control.steer = 0.5, LEAD * self.decisions
        self.control = control
        return control

    def destroy(self) -> None:
        text = json.dumps(self.metric_info)
        (self.save_path / "at_the_end.json").write_text(text)
        self.gone = True
