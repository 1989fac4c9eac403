"""Terms that not every reader knows: each is explained where it stands first on a page."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from markupsafe import Markup, escape

#: Term -> what it means. It is found in any case of its first letter, and in the plural.
TERMS: dict[str, str] = {
    "AIC": "Akaike's information criterion: misfit plus a penalty for each fitted number. Lower is "
    "better; differences below 2 decide nothing.",
    "autocorrelated": "Neighbouring samples resemble each other, as those of people usually do.",
    "bootstrap": "Intervals by repetition: the fit is repeated on recordings simulated from it.",
    "95 % CI": "95 % confidence interval.",
    "coherence": "The share of the movement at this frequency that follows the perturbation "
    "linearly: 1 all of it, 0 none.",
    "condition number": "Largest over smallest eigenvalue of the cost weights.",
    "cost weight": "How much the square of a tilt, velocity or torque adds to the cost that the "
    "controller keeps small.",
    "Fisher information": "What recordings say of parameters; its inverse is the least variance.",
    "gain": "How much the controller commands per unit of a tilt or velocity, as long as the limit "
    "is not reached.",
    "Hedges' g": "Difference of two means over their standard deviation, corrected for small "
    "groups.",
    "Holm": "A correction of p-values, so that all comparisons together err in 5 of 100 only.",
    "ICC": "Intraclass correlation: the share of the variance that is between people. 1: a second "
    "visit finds the same order of people.",
    "inverse LQR": "The classical method: it identifies cost weights as if torque were unlimited.",
    "left-out trials": "Each trial is predicted by a model fitted to the others, which has not "
    "seen it.",
    "model predictive control": "At every sample the controller plans a short time ahead within "
    "its limits, and carries out the first step of the plan.",
    "neural delay": "The time that nerves take, as a chain of internal states. Their gains have no "
    "meaning one by one.",
    "profile likelihood": "An interval by moving one number, all others fitted again, until the "
    "recordings contradict it.",
    "residual": "Recorded minus modelled output.",
    "RMS": "Root mean square: the size of a signal.",
    "SEM": "Standard error of measurement: the scatter of one person's result.",
    "typical": "Of the size that it has in these recordings (root mean square).",
    "variance accounted for": "100 % if model and recording coincide, 0 % if the model is no "
    "better than a constant zero.",
    "VAF": "Variance accounted for: 100 % if model and recording coincide, 0 % if the model is no "
    "better than a constant zero.",
}


@dataclass
class Glossary:
    """The terms of one page; each is explained where it stands first."""

    _explained: set[str] = field(default_factory=set)

    def marked(self, text: str) -> str:
        """The `text` with an explanation at each term that is new on the page."""
        if isinstance(text, Markup):
            return text
        left = TERMS.keys() - self._explained
        found = {term: match for term in left if (match := _pattern(term).search(text))}
        pieces, start = [], 0
        for term, match in sorted(found.items(), key=lambda item: (item[1].start(), -len(item[0]))):
            if match.start() < start:  # within a longer term
                continue
            self._explained.add(term)
            pieces += [escape(text[start : match.start()]), self._term(match[0], TERMS[term])]
            start = match.end()
        return Markup("").join([*pieces, escape(text[start:])])

    def _term(self, word: str, meaning: str) -> Markup:
        name = f"tip-{len(self._explained)}"
        return Markup(
            '<span class="term" tabindex="0" aria-describedby="{0}">{1}'
            '<span class="tip" role="tooltip" id="{0}">{2}</span></span>'
        ).format(name, word, meaning)


def _pattern(term: str) -> re.Pattern[str]:
    first = term[0]
    begin = re.escape(first) if term[:2].isupper() else f"[{first.lower()}{first.upper()}]"
    plural = "" if term[-1].isupper() else "s?"
    return re.compile(rf"(?<!\w){begin}{re.escape(term[1:])}{plural}(?!\w)")
