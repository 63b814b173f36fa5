"""The world that is driven in, on highway-env: routes, traffic, scenarios, cameras.

It knows no policy and no model: at each frame it is given a `Control`.

Raises:
    MissingExtraError: On import, if the extra ``highway`` is not installed.
"""

from importlib.util import find_spec

from me2e_compress.errors import MissingExtraError

for _package in ("highway_env", "gymnasium", "scipy", "cv2"):
    if find_spec(_package) is None:
        raise MissingExtraError(_package, "highway")
