"""Minimum cuts of flow networks, by Dinic's algorithm (1970)."""

import math
from collections import deque


class FlowNetwork:
    """A flow network of vertices, numbered from 0, and edges with capacities."""

    def __init__(self) -> None:
        self.edges: list[list[int]] = []
        self.head: list[int] = []
        self.left: list[float] = []

    def vertex(self) -> int:
        """Add a vertex and return its number."""
        self.edges.append([])
        return len(self.edges) - 1

    def edge(self, tail: int, head: int, capacity: float = math.inf) -> None:
        """Add an edge; edge ``n ^ 1`` is the reverse of edge ``n``."""
        for start, end, amount in ((tail, head, capacity), (head, tail, 0.0)):
            self.edges[start].append(len(self.head))
            self.head.append(end)
            self.left.append(amount)

    def cut(self, source: int, sink: int) -> set[int]:
        """Return the source's side of the cheapest cut; of equal ones the largest.

        No path of infinite capacity may lead from source to sink.
        """
        # Augment along shortest paths until none is left
        while (levels := self._levels(source))[sink] >= 0:
            self._block(source, sink, levels)
        # Everything that cannot reach the sink is on the source's side
        reaching, waiting = {sink}, [sink]
        while waiting:
            for edge in self.edges[waiting.pop()]:
                if self.left[edge ^ 1] > 0 and self.head[edge] not in reaching:
                    reaching.add(self.head[edge])
                    waiting.append(self.head[edge])
        return set(range(len(self.edges))) - reaching

    def _levels(self, source: int) -> list[int]:
        """Return each vertex's distance over edges with capacity left, or -1."""
        levels = [-1] * len(self.edges)
        levels[source] = 0
        waiting = deque([source])
        while waiting:
            vertex = waiting.popleft()
            for edge in self.edges[vertex]:
                head = self.head[edge]
                if self.left[edge] > 0 and levels[head] < 0:
                    levels[head] = levels[vertex] + 1
                    waiting.append(head)
        return levels

    def _block(self, source: int, sink: int, levels: list[int]) -> None:
        untried = [iter(edges) for edges in self.edges]
        path: list[int] = []
        vertex = source
        while True:
            if vertex == sink:
                path = self._fill(path)
                vertex = self.head[path[-1]] if path else source
                continue
            # Advance along an edge of the level graph
            for edge in untried[vertex]:
                if (
                    self.left[edge] > 0
                    and levels[self.head[edge]] == levels[vertex] + 1
                ):
                    path.append(edge)
                    vertex = self.head[edge]
                    break
            else:
                # A dead end: retreat, or stop at the source
                if not path:
                    return
                levels[vertex] = -1
                vertex = self.head[path.pop() ^ 1]

    def _fill(self, path: list[int]) -> list[int]:
        """Saturate a path; return the part before the first full edge."""
        amount = min(self.left[edge] for edge in path)
        for edge in path:
            self.left[edge] -= amount
            self.left[edge ^ 1] += amount
        full = next(at for at, edge in enumerate(path) if self.left[edge] <= 0)
        return path[:full]
