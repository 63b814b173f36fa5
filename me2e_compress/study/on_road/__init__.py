"""Search for the scheme within budgets that drives best."""

from me2e_compress.study.on_road.road_options import Limits, RoadSearchOptions
from me2e_compress.study.on_road.road_result import RoadSearchResult
from me2e_compress.study.on_road.road_search import search_on_road

__all__ = ["Limits", "RoadSearchOptions", "RoadSearchResult", "search_on_road"]
