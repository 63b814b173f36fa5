"""Everything this package raises on purpose.

Every message says what was found, what there is, and names the culprit, on one line.
"""


class Me2eError(Exception):
    """Base class: the command line prints these on one line, without a traceback."""


class GraphError(Me2eError):
    """A file is not a graph we can read, or lacks something we need."""


class ProviderError(Me2eError):
    """An execution provider or a library of operators is missing."""


class FramesError(Me2eError):
    """Calibration frames are missing, of another model, or not finite."""


class ModuleMapError(Me2eError):
    """A module map is malformed, or one of its patterns matches nothing."""


class RecipeError(Me2eError):
    """A recipe or pipeline names an unknown pass or option."""


class OptionError(RecipeError):
    """An option is missing or takes no such value: a usage error."""


class PreconditionError(Me2eError):
    """A pass was given a graph it cannot work on."""


class PassError(Me2eError):
    """A pass broke; the cause is chained."""


class VerificationError(Me2eError):
    """The graph after a pass is not a valid successor of the one before."""


class EnergyError(Me2eError):
    """A counter of energy, or a file of one, is not usable."""


class EvaluationError(Me2eError):
    """A route, a policy or a folder of results is not usable."""


class StudyError(Me2eError):
    """A study is malformed, or names what it does not have."""


class MissingExtraError(Me2eError):
    """An optional package is not installed; the message says which extra brings it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(package, extra)  # both: pickle makes it of its arguments

    def __str__(self) -> str:
        """Return the line that says what to install."""
        package, extra = self.args
        return f"{package} is not installed: pip install 'me2e-compress[{extra}]'"


class BrokenPackageError(Me2eError):
    """An optional package is installed, and importing it fails."""

    def __init__(self, package: str, extra: str, reason: str) -> None:
        super().__init__(package, extra, reason)

    def __str__(self) -> str:
        """Return the line that says why, and what to install again."""
        package, extra, reason = self.args
        return (
            f"{package} is installed, but cannot be imported: {reason}: pip install"
            f" --force-reinstall 'me2e-compress[{extra}]'"
        )
