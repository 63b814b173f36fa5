"""What lossy passes did to a model, as it is said, shown and reported."""

import dataclasses
from collections.abc import Iterator, Mapping

from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.floor import Floor, Shortfall, shown
from me2e_compress.sensitivity.remedy import Remedy
from me2e_compress.workflows.result import Table, counted, table

NOT_ASKED = "--measure-frames 0"


@dataclasses.dataclass(frozen=True)
class MeasuredLoss:
    """How true a compressed model stayed, and where it did not.

    Attributes:
        fidelity: fidelity to the graph before the first lossy pass; None if not
            measured.
        on: which frames were used, or why nothing was measured, in words.
        incomparable: whether an output is not finite, or of another shape than before.
        unsteady: outputs that are not judged, with their dB or metres: the uncompressed
            model itself falls that low when its largest input is rounded to int8.
        shortfalls: outputs below the floor, the worst first.
        guilty: the passes that cause the shortfalls.
        remedy: what would restore the quality; None if nothing was searched, because
            another pass is guilty, or the one that quantizes takes no overrides.
        seconds: CPU time of measuring and searching.
        search_seconds: CPU time of the search for a remedy.
    """

    fidelity: Fidelity | None
    on: str
    floor: Floor
    unsteady: Mapping[str, float] = dataclasses.field(default_factory=dict)
    shortfalls: tuple[Shortfall, ...] = ()
    guilty: tuple[str, ...] = ()
    remedy: Remedy | None = None
    seconds: float = 0.0
    search_seconds: float = 0.0
    incomparable: bool = False

    def lines(self) -> Iterator[str]:
        """Yield how far the outputs moved, and which of them are not judged."""
        found = self.fidelity
        if found is not None:
            yield self._summary(found)
        elif self.on != NOT_ASKED:
            yield f"fidelity: not measured ({self.on})"
        if found is not None and self.unsteady:
            plan = "" if found.plan is None else found.plan_output
            low = (
                shown(value, "m" if name == plan else "dB")
                for name, value in self.unsteady.items()
            )
            yield (
                f"not judged: {', '.join(self.unsteady)}: the graph itself,"
                f" uncompressed, falls to {', '.join(low)} when only its largest input"
                " is rounded to int8; it chooses between near-equal candidates, and"
                " the road tells what that means"
            )

    def alerts(self) -> Iterator[str]:
        """Yield what cannot be compared or is below the floor, and what helps."""
        if self.incomparable:
            yield f"the outputs cannot be compared: {self.on}"
        if self.shortfalls:
            low, guilty = ", ".join(map(str, self.shortfalls)), ", ".join(self.guilty)
            yield f"below the floor ({self.floor}): {low}; lost in {guilty}"
            if self.remedy is not None:
                yield from self._cure(self.remedy)

    def table(self) -> Table | None:
        """Return the SQNR and largest error of every output; None if not measured."""
        found = self.fidelity
        if found is None:
            return None
        below = {each.output for each in self.shortfalls}
        unjudged = {*self.unsteady, *(e.name for e in found.outputs if e.discrete)}
        rows = [
            (
                each.name,
                f"{each.sqnr_db:z.1f}",
                f"{each.error:.1e}",
                "below"
                if each.name in below
                else "not judged"
                if each.name in unjudged
                else "above",
            )
            for each in found.outputs
        ]
        rows += [(name, "removed", "", "") for name in found.missing]
        columns = ("output", "SQNR dB", "max|a-b|/max|a|", "floor")
        title = f"Fidelity on {counted(found.frames, 'frame')} {self.on}"
        return table(title, columns, rows)

    def record(self) -> dict[str, object]:
        """Return what the report says of it: all but the time."""
        names = [each.name for each in dataclasses.fields(self)]
        names = [each for each in names if each not in ("seconds", "search_seconds")]
        said = {name: getattr(self, name) for name in names}
        if self.remedy is not None:
            overrides = {"overrides": self.remedy.overrides()}
            said["remedy"] = dataclasses.asdict(self.remedy) | overrides
        return said

    def _summary(self, found: Fidelity) -> str:
        """Return how far the plan moved, and which output is the noisiest."""
        said = []
        if found.plan is not None:
            said.append(
                f"the plan moves {found.plan.mean_m:.3f} m on average,"
                f" {found.plan.max_m:.2f} m at most"
            )
        others = [each for each in found.outputs if each.name != found.plan_output]
        judged = [e for e in others if not e.discrete and e.name not in self.unsteady]
        if judged:
            worst = min(judged, key=lambda each: each.sqnr_db)
            noise = shown(worst.sqnr_db, "dB")
            said.append(f"the noisiest output is {worst.name}, {noise}")
        where = f"on {counted(found.frames, 'frame')} {self.on}"
        return f"{'; '.join(said) or 'no output could be judged'} ({where})"

    def _cure(self, remedy: Remedy) -> Iterator[str]:
        found = remedy.fidelity
        runs = f"{counted(remedy.trials, 'variant')} run on"
        runs += f" {counted(found.frames, 'frame')}"
        # name the nodes to blame, or say that none can be
        blamed = [
            *map(str, remedy.nodes),
            *(f"many nodes of module {name}" for name in remedy.modules),
        ]
        if not blamed:
            yield f"no few nodes or modules are to blame ({runs})"
            return
        yield f"lost at {'; '.join(blamed)}"
        # show the overrides with what they achieve
        left = ", ".join(map(str, remedy.shortfalls))
        after = (
            f"{left}, still below the floor"
            if left
            else _figure(found, self.shortfalls[0].output)
        )
        yield f"with --overrides of these lines: {after} ({runs})"
        yield remedy.overrides().rstrip()


def _figure(found: Fidelity, output: str) -> str:
    if found.plan is not None and output == found.plan_output:
        return f"{output} {shown(found.plan.mean_m, 'm')}"
    (value,) = (each.sqnr_db for each in found.outputs if each.name == output)
    return f"{output} {shown(value, 'dB')}"
