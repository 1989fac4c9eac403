"""What can go wrong, as one tree of exceptions that say what to do.

Every message is one line: the subject (an argument, a file, a sample), what was found there,
and the remedy; signs that would break the line are escaped. The three parts are kept apart so that
the command line, a report and a worker process can show them without parsing text.
"""

from __future__ import annotations

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

    Examples
    --------
    >>> import impc
    >>> try:
    ...     impc.Weights([[1, 0], [0, 1]], -1)
    ... except impc.ImpcError as error:
    ...     print(error.subject, "|", error.remedy)
    R | every input needs a positive cost
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
    """An argument that cannot be used as it is.

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
    impc.errors.WeightsError: R: is not positive definite: its least eigenvalue is -1; ...
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
    """A recording in which the subject fell: other recordings of the subject may be used."""


class InfeasibleError(ImpcError):
    """A state from which no input sequence keeps the bounds.

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
    """A numerical method that ended without an answer.

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
    impc.errors.SolverError: sample ...: the state left every reasonable range; ...
    """


class OutputError(ImpcError):
    """A result that could not be written.

    Examples
    --------
    >>> import impc
    >>> impc.write_table("trial.docx", impc.make_table("simulated", {"angle": [0.1, 0.2]}))
    Traceback (most recent call last):
        ...
    impc.errors.OutputError: trial.docx: has the ending '.docx', and not .csv, ...
    """


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
