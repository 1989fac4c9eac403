"""What can go wrong, as one tree of exceptions that say what to do.

Every message is one line: the subject (an argument, a file, a sample), what was found there,
and the remedy. The three parts are kept apart so that the command line, a report and a worker
process can show them without parsing text.
"""

from __future__ import annotations

__all__ = [
    "BoundsError",
    "DataError",
    "ImpcError",
    "InfeasibleError",
    "InputError",
    "OutputError",
    "PlantError",
    "SolverError",
    "WeightsError",
]


class ImpcError(Exception):
    """Root of all errors raised on purpose.

    Parameters
    ----------
    subject : str
        The argument, file or sample at fault.
    problem : str
        What was expected and what was given instead.
    remedy : str
        What to do about it.
    """

    def __init__(self, subject: str, problem: str, remedy: str) -> None:
        # All three go to Exception.__init__ so that the error survives pickling by workers.
        super().__init__(subject, problem, remedy)
        self.subject = subject
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.subject}: {self.problem}; {self.remedy}"


class InputError(ImpcError, ValueError):
    """An argument that cannot be used as it is."""


class PlantError(InputError):
    """A plant that is not discrete, not stabilisable, or of the wrong size."""


class WeightsError(InputError):
    """Weights that are not definite enough, or that no gain or no weights can match."""


class BoundsError(InputError):
    """Bounds that cross, or that exclude the equilibrium."""


class DataError(InputError):
    """Recorded data that are missing, not finite, or of the wrong shape."""


class InfeasibleError(ImpcError):
    """A state from which no input sequence keeps the bounds."""


class SolverError(ImpcError):
    """A numerical method that ended without an answer."""


class OutputError(ImpcError):
    """A result that could not be written."""
