"""Episodes to learn from: routes driven with the expert's labels at every sample.

A folder holds ``dataset.json`` (the `Collection`) and one ``.npz`` a route, its
arrays uncompressed. T samples; poses and plans in metres; "ego" is the ego frame of
that sample, x forward and y left.

* ``jpeg`` uint8 [bytes], ``jpeg_offsets`` int64 [T + 1]: six RGB images a sample, see
  `decode`
* ``time_us`` int64 [T]; ``pose`` float64 [T, 3]: x, y, heading in the world
* ``can_bus`` float32 [T, 18]: `Observation.can_bus` with [0:3] and [17] zero, since
  they depend on the spacing; ``command`` int64 [T]
* ``rest_s`` float32 [T]: seconds since the ego was last below 0.1 m/s, at most 60; 60
  if it never was
* ``plan`` float32 [T, 6, 2]: the expert's, ego; ``target_m`` float32 [T]: metres left
  of the route at which it aims
* ``plan_alone`` float32 [T, 6, 2]: the same if there were no actors
* ``lateral_m`` float32 [T]: metres left of the route
* ``path`` float32 [T, 25, 2]: the route ahead every 2 m, ego, straight beyond its end
* ``path_attributes`` float32 [T, 25, 4]: drivable metres to the left, to the right,
  to the left with oncoming lanes, and the expert's speed ceiling (m/s)
* ``agents`` float32 [T, 24, 10]: class (0 vehicle, 1 bicycle, 2 pedestrian, 3 cone or
  barrier, -1 none), x, y, cosine, sine, length, width, velocity x, y, braking; ego;
  the nearest of those from 16 m behind to 48 m ahead and 24 m to each side
* ``futures`` float32 [T, 24, 6, 2]: where they were 0.5 .. 3 s later, ego of now; NaN
  if the route or they ended before
* ``signals`` float32 [T, 4, 8]: kind (0 light, 1 stop, 2 give way, -1 none), state (0
  red, 1 yellow, 2 green, -1 none), x, y, cosine, sine, metres from the ego's centre
  along the route to the line (NaN if not on the route), 1 if the stop is served;
  those on the route first, then the nearest
* ``ground`` uint8 [T, 64, 48]: `PixelClass` of the ground on `GRID`, 1 m cells
* ``occupancy`` uint8 [T, 6, 384]: packed bits of [6, 64, 48] on the same grid: what
  all actors covered 0.5 .. 3 s later; zeros where unknown
* ``known_steps`` int64 [T]: how many of those six the route lasted
* ``crashed`` bool, ``scenario`` and ``route`` str: of the episode
"""

from models.driver.episodes.agents import GRID
from models.driver.episodes.collecting import collect
from models.driver.episodes.collection import Collection
from models.driver.episodes.jpeg import decode

__all__ = ["GRID", "Collection", "collect", "decode"]
