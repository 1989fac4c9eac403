"""What can go wrong, as one tree of exceptions that say what to do.

Every message is one line: the subject (an argument, a file, a sample), what was found there,
and the remedy; signs that would break the line are escaped. The three parts are kept apart so that
the command line, a report and a worker process can show them without parsing text.
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
    "brief",
    "one_line",
]

# A line that is longer than this hides its remedy; names and values are cut in the middle.
_LONGEST = 600
_MANY_BITS = 128  # 39 digits
_ESCAPED_BYTE = range(0xDC80, 0xDD00)


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
        return one_line(f"{self.subject}: {self.problem}; {self.remedy}")


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


def one_line(text: object, longest: int = _LONGEST) -> str:
    r"""A `text` as one line that any terminal, page and file can take.

    Line breaks, control characters, marks that turn the direction of writing and bytes of a name
    that are not UTF-8 become what Python writes for them, such as ``\n`` and ``\xff``; of a text of
    more than `longest` characters the middle is left out.
    """
    line = "".join(part if part.isprintable() else _escaped(part) for part in _text(text))
    if len(line) <= longest:
        return line
    half = (longest - 5) // 2
    return f"{line[:half]} ... {line[-half:]}"


def brief(value: object, longest: int = 60) -> str:
    """A `value` that somebody gave, for a message: at most `longest` characters of it."""
    if isinstance(value, int) and value.bit_length() > _MANY_BITS:
        return f"an integer of about {value.bit_length() * 0.30103:.0f} digits"
    return one_line(value, longest)


def _text(value: object) -> str:
    """str(value), also of what has none: an integer of 5000 digits, a class that fails at it."""
    try:
        return str(value)
    except Exception:  # whatever a value of somebody else's does
        return f"a {type(value).__name__}"


def _escaped(character: str) -> str:
    code = ord(character)
    if code in _ESCAPED_BYTE:  # how Python keeps a byte of a file's name that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
