"""Style of figures, and conversion to SVG for light mode, dark mode and print.

In the SVG of a page each colour is replaced by the CSS variable of the same colour in style.css. No
meaning depends on colour alone. matplotlib is imported when the first figure is drawn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from impc.errors import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from matplotlib.ticker import Formatter

#: Colours of text and axes; of secondary items; of grid lines; of the background.
INK, MUTED, RULE, PAPER = "#1b2229", "#566270", "#d9dfe5", "#ffffff"
#: Colours of the model; of samples at a limit; of the area beyond it; of recordings.
BLUE, VERMILLION, FORBIDDEN, RECORDED = "#0a5ca8", "#a84300", "#f3e6dc", "#b4bec9"
#: Colour of a third curve.
GREEN = "#0f6130"
_VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    RULE: "rule",
    PAPER: "bg",
    BLUE: "accent",
    VERMILLION: "limit",
    FORBIDDEN: "band",
    RECORDED: "rec",
    GREEN: "ok",
}

#: Width in inches of a figure over the whole page, and next to text.
WIDE, HALF = 11.0, 7.2

# Decades of a logarithmic axis below which 1, 2 and 5 are labelled, and below which 1, 2 and 5 are
# too far apart.
_DECADES, _NO_DECADE = 1.8, 0.7

# Any: the types of the keys differ between versions of matplotlib.
_RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.labelsize": 11.0,
    "axes.titlesize": 11.0,
    "axes.titlelocation": "left",
    "legend.fontsize": 10.5,
    "xtick.labelsize": 10.5,
    "ytick.labelsize": 10.5,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 5.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "svg.fonttype": "none",  # text in the fonts of the page, searchable and readable aloud
    "pdf.fonttype": 42,  # journals require TrueType fonts
    "path.simplify_threshold": 0.3,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    # Override the user's settings for figures without a layout engine.
    "figure.autolayout": False,
    "figure.constrained_layout.use": False,
}


@contextmanager
def page_style() -> Iterator[None]:
    """Apply the style inside the block and restore matplotlib's settings afterwards."""
    import matplotlib as mpl  # noqa: PLC0415

    with mpl.rc_context():
        mpl.rcdefaults()  # drop the user's settings: text.usetex fails if TeX is missing
        mpl.rcParams.update(_RC)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return a figure outside pyplot; width and height in inches."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    return Figure(figsize=(width, height), layout="constrained")


def strip(ax: Axes, title: str) -> None:
    """Set the title of a panel and draw its zero line."""
    ax.set_title(title, pad=5)
    ax.axhline(0, color=RULE, linewidth=0.8, zorder=0)


def panels(
    signals: Sequence[tuple[str, Sequence[Any], Sequence[Any]]], step: float, label: str
) -> Figure:
    """Panels of signals (title, recorded, modelled) over time, one sample every `step`."""
    figure = new_figure(HALF, 0.5 + 1.35 * len(signals))
    axes = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (title, *curves) in zip(axes, signals, strict=True):
        strip(ax, title)
        for values, color, width in zip(curves, (RECORDED, BLUE), (4.5, 1.4), strict=True):
            ax.plot([step * k for k in range(len(values))], values, color=color, linewidth=width)
    axes[-1].set_xlabel(label)
    return figure


def plain_log(*axes: Axis) -> None:
    """Label logarithmic axes whose ends are known with a few plain numbers, none overprinted."""
    from matplotlib.ticker import LogLocator, MaxNLocator  # noqa: PLC0415

    for axis in axes:
        low, high = axis.get_view_interval()
        decades = math.log10(high / low)
        subs = (1.0, 2.0, 5.0) if decades < _DECADES else (1.0,)
        few = decades < _NO_DECADE
        axis.set_major_locator(MaxNLocator(3) if few else LogLocator(subs=subs, numticks=5))
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.minorticks_off()


def drawn(draw: Callable[[], Figure], kind: str) -> bytes:
    """Figure as a "svg" or "pdf" file, without date or program name."""
    with page_style():
        return render(draw(), kind)


def inline(figure: bytes, name: str, title: str) -> Markup:
    """Inline SVG of a figure as `drawn`."""
    name = re.sub(r"\W+", "-", name)  # in ids of the page
    text = figure.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = text.replace("url(#", f"url(#{name}-").replace('xlink:href="#', f'href="#{name}-')
    text = re.sub(r"font: (?:(\d+) )?([\d.]+)px [^;\"]+", _font, text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    first, _, rest = text.partition(">")
    box = re.findall(r'viewBox="([\d. ]+)"', first)[0]
    head = (
        f'<svg viewBox="{box}" style="--width: {box.split()[2]}" role="img" '
        f'aria-labelledby="{name}-title"><title id="{name}-title">{escape(title)}</title>'
    )
    return Markup(head + re.sub(r"\n\s*", "\n", rest))


def _font(found: re.Match[str]) -> str:
    weight = f"font-weight: {found[1]}; " if found[1] else ""
    return f"{weight}font-size: {found[2]}px"


def render(figure: Figure, kind: str) -> bytes:
    """Bytes of a figure as "svg", "pdf" or "png"; reproducible for the same figure."""
    import matplotlib as mpl  # noqa: PLC0415

    _set_literally(figure)
    metadata = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}}
    stream = BytesIO()
    with mpl.rc_context({"svg.hashsalt": "impc"}):
        figure.savefig(stream, format=kind, metadata=metadata.get(kind), dpi=200, facecolor=PAPER)
    return stream.getvalue()


def _set_literally(figure: Figure) -> None:
    """Disable mathematical markup in all texts except matplotlib's own tick labels."""
    from matplotlib.text import Text  # noqa: PLC0415
    from matplotlib.ticker import FixedFormatter, FuncFormatter  # noqa: PLC0415

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
