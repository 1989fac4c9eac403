"""Exception classes; each message names the cause and the remedy.

A message is one line: subject (an argument, file or sample), problem, and remedy, with control
characters escaped. The three parts are separate attributes, so that the command line, reports and
worker processes can show them without parsing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

# Longest message; longer names and values are shortened in the middle.
_LONGEST = 600
_MANY_BITS = 128  # 39 digits
_ESCAPED_BYTE = range(0xDC80, 0xDD00)


class ImpcError(Exception):
    """Base class of all errors that impc raises on purpose.

    Parameters
    ----------
    subject : str
        Argument, file or sample at fault.
    problem : str
        What was expected and what was given.
    remedy : str
        What to do.

    Attributes
    ----------
    file : str
        Recording or configuration at fault; empty if there is none.
    place : tuple of str
        TOML path at fault, such as ``("signals", "theta1", "unit")``; empty if there is none.

    Examples
    --------
    >>> import impc
    >>> try:
    ...     impc.Weights([[1, 0], [0, 1]], -1)
    ... except impc.ImpcError as error:
    ...     print(error.subject, "|", error.remedy)
    R | give every input a positive cost weight
    """

    file: str = ""
    place: tuple[str, ...] = ()

    def __init__(self, subject: str, problem: str, remedy: str) -> None:
        # All three go to Exception.__init__ so that the error can be pickled by workers.
        super().__init__(subject, problem, remedy)
        self.subject = subject
        self.problem = problem
        self.remedy = remedy

    def at(self, file: str, *place: str) -> Self:
        """Set the `file` and the TOML path (`place`) at fault unless they are set; return self."""
        self.file, self.place = self.file or file, self.place or place
        return self

    def __str__(self) -> str:
        return one_line(f"{self.subject}: {self.problem}; {self.remedy}")


class InputError(ImpcError, ValueError):
    """An argument that cannot be used.

    Examples
    --------
    >>> import impc
    >>> impc.Weights([[1, 2], [3, 4]], 1)
    Traceback (most recent call last):
        ...
    impc.errors.InputError: Q: is not symmetric; give (M + M')/2
    """


class PlantError(InputError):
    """A plant that is not discrete, not stabilisable, or of the wrong size.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> impc.Plant(control.ss([[2]], [[0]], [[1]], 0, 1))
    Traceback (most recent call last):
        ...
    impc.errors.PlantError: plant: is not stabilisable: no input reaches the mode 2+0j; ...
    """


class WeightsError(InputError):
    """Weights that are not definite enough, or that no gain or no weights can match.

    Examples
    --------
    >>> import impc
    >>> impc.Weights([[1, 0], [0, 1]], -1)
    Traceback (most recent call last):
        ...
    impc.errors.WeightsError: R: is not positive definite: its smallest eigenvalue is -1; ...
    """


class BoundsError(InputError):
    """Bounds that cross, or that exclude the equilibrium.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> impc.Bounds(impc.Plant(yalmip_example()), u_max=-1)
    Traceback (most recent call last):
        ...
    impc.errors.BoundsError: u_min, u_max: exclude the origin for u: [-inf, -1]; ...
    """


class DataError(InputError):
    """Recorded data that are missing, not finite, or of the wrong shape.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> impc.Recording(impc.Plant(yalmip_example()), [[1, 3]])
    Traceback (most recent call last):
        ...
    impc.errors.DataError: outputs: has 1 samples; give at least 2
    """


class FallError(DataError):
    """A recording in which the subject fell; their other recordings may be usable."""


class InfeasibleError(ImpcError):
    """A state from which no input sequence satisfies the bounds.

    Examples
    --------
    >>> import warnings
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> with warnings.catch_warnings(action="ignore"):
    ...     run = law.simulate([9, 3], steps=20)
    >>> impc.require_complete(law, run)
    Traceback (most recent call last):
        ...
    impc.errors.InfeasibleError: x0: no input sequence keeps the bound u <= 1 ...
    """


class SolverError(ImpcError):
    """A numerical method that failed.

    Examples
    --------
    >>> import warnings
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> law = impc.Controller.from_gain(plant, [[0, 0]], impc.Bounds(plant), 3, terminal_set=False)
    >>> with warnings.catch_warnings(action="ignore"):
    ...     run = law.simulate([1, 3], steps=200)
    >>> impc.require_complete(law, run)
    Traceback (most recent call last):
        ...
    impc.errors.SolverError: sample ...: the state diverged; ...
    """


class OutputError(ImpcError):
    """A result that could not be written.

    Examples
    --------
    >>> import impc
    >>> impc.write_table("trial.docx", impc.make_table("simulated", {"angle": [0.1, 0.2]}))
    Traceback (most recent call last):
        ...
    impc.errors.OutputError: trial.docx: has the ending '.docx', not one of .csv, ...
    """


@contextmanager
def blamed(file: str, *place: str) -> Iterator[None]:
    """Errors inside are `at` this file and TOML path, unless they name their own."""
    try:
        yield
    except ImpcError as error:
        error.at(file, *place)
        raise


def one_line(text: object, longest: int = _LONGEST) -> str:
    r"""Return `text` as one printable line of at most `longest` characters.

    Line breaks, control and bidirectional characters, and bytes that are not UTF-8 are escaped as
    in Python (``\n``, ``\xff``); of a longer text the middle is left out.
    """
    line = "".join(part if part.isprintable() else _escaped(part) for part in _text(text))
    if len(line) <= longest:
        return line
    half = (longest - 5) // 2
    return f"{line[:half]} ... {line[-half:]}"


def brief(value: object, longest: int = 60) -> str:
    """Shorten a `value` for a message to at most `longest` characters."""
    if isinstance(value, int) and value.bit_length() > _MANY_BITS:
        return f"an integer of about {value.bit_length() * 0.30103:.0f} digits"
    return one_line(value, longest)


def _text(value: object) -> str:
    """str(value), also if that fails (an integer of 5000 digits, a faulty class)."""
    try:
        return str(value)
    except Exception:  # a faulty class may raise anything
        return f"a {type(value).__name__}"


def _escaped(character: str) -> str:
    code = ord(character)
    if code in _ESCAPED_BYTE:  # Python's representation of a file-name byte that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
