"""How every figure looks: sizes of a journal, marks that survive grey print and colour blindness.

Colours are three of the set of Okabe and Ito. None of them carries a meaning alone: recorded data
are open markers, models are lines; the first state is round and solid, the second square and
dashed.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FuncFormatter

from impc.errors import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from matplotlib.ticker import Formatter

# Their lightness (46, 56, 60 of 100) is too near to distinguish them in grey, hence the markers
# and line styles beside them.
#: Colours of Okabe and Ito (2008).
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
#: Axes, text and recorded data.
INK = "#222222"
#: Areas: beyond a bound, or a band that noise explains.
FORBIDDEN = "#E3E3E3"
#: Inside of the terminal set.
SET_FILL = "#DCE9F2"

#: Column widths in inches, as most journals of the field set them.
SINGLE_COLUMN, DOUBLE_COLUMN = 3.5, 7.2
# 700 pixels for one column: sharp on a telephone of 360 points at twice the density.
_DPI = 200

# Any: matplotlib types its keys one by one, and each version has others.
_RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture on every machine
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "legend.fontsize": 7.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "pdf.fonttype": 42,  # journals ask for TrueType, so that text stays text
    "figure.facecolor": "white",
    # A figure without an engine stays as it is laid out, whatever the user's own settings.
    "figure.autolayout": False,
    "figure.constrained_layout.use": False,
    "savefig.facecolor": "white",
}


@dataclass(frozen=True)
class Mark:
    """How one signal is drawn, in the words of matplotlib."""

    color: str  # Such as "#0072B2"
    marker: str  # Empty for none
    line: str  # Its style, such as "--"


#: Of the first state and of the second.
STATE_MARKS = (Mark(BLUE, "o", "-"), Mark(VERMILLION, "s", "--"))


@contextmanager
def journal_style() -> Iterator[None]:
    """Apply the style inside the block; matplotlib's settings are as before after it."""
    with mpl.rc_context():
        mpl.rcdefaults()  # not the user's own: text.usetex alone ends a figure where TeX is missing
        mpl.rcParams.update(_RC)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return a figure that belongs to no window and to no list; width and height in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def drawn(figures: Mapping[str, Figure], *, mathematics: bool = False) -> dict[str, bytes]:
    """Each of the `figures` as PNG and PDF, by the name of its file."""
    return {
        f"{name}.{kind}": content
        for name, figure in figures.items()
        for kind, content in render(figure, mathematics=mathematics).items()
    }


def render(figure: Figure, *, mathematics: bool = False) -> dict[str, bytes]:
    r"""Return the figure as ``"png"`` and ``"pdf"``, without date or program name.

    The same figure gives the same bytes, so that a committed picture changes only when it does.
    """
    files = {}
    if not mathematics:
        _set_literally(figure)
    # Once for both files, and nothing is drawn for it. Without an engine, since the one that
    # "none" leaves behind has everything drawn once more before each file.
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine(None)
    for kind, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        stream = BytesIO()
        figure.savefig(stream, format=kind, dpi=_DPI, metadata=metadata)
        files[kind] = stream.getvalue()
    return files


def _set_literally(figure: Figure) -> None:
    """Let no text be read as mathematics, but the numbers that matplotlib itself writes."""
    numbers: set[Text] = set()
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            numbers |= set(axis.findobj(Text)) - {axis.label}
            formatter = axis.get_major_formatter()
            if isinstance(formatter, (FuncFormatter, FixedFormatter)):  # names at the ticks
                axis.set_major_formatter(FuncFormatter(_literal_tick(formatter)))
    found: set[Text] = set(figure.findobj(Text))
    for text in found - numbers:
        text.set_parse_math(False)
        text.set_text("\n".join(one_line(line) for line in text.get_text().split("\n")))


def _literal_tick(names: Formatter) -> Callable[[float, int | None], str]:
    return lambda value, place: one_line(names(value, place)).replace("$", r"\$")
