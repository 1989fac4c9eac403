"""Tooltips: each technical term is explained at its first occurrence on a page."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from markupsafe import Markup, escape

_VAF = "100 % if model and recording coincide, 0 % if the model is no better than a constant zero."
#: Term -> explanation. Matches in any case of its first letter, and in the plural.
TERMS: dict[str, str] = {
    "AIC": "Akaike's information criterion: misfit plus a penalty for each fitted number. Lower is "
    "better; differences below 2 are not meaningful.",
    "autocorrelated": "Correlated with earlier samples, as human movement is and white noise is "
    "not.",
    "bootstrap": "Intervals by repetition: the fit is repeated on recordings simulated from it.",
    "95 % CI": "95 % confidence interval.",
    "coherence": "The share of the movement at this frequency that follows the perturbation "
    "linearly: 1 all of it, 0 none.",
    "condition number": "Largest over smallest eigenvalue of the cost weights.",
    "cost weight": "How much the square of a tilt, velocity or torque adds to the cost that the "
    "controller minimises.",
    "Fisher information": "Information of recordings about parameters; the diagonal of its inverse "
    "is the smallest possible variance of unbiased estimates.",
    "gain": "Command of the controller per unit of a tilt or velocity, as long as the limit is not "
    "reached.",
    "Hedges' g": "Difference of two means divided by their standard deviation, corrected for small "
    "groups.",
    "Holm": "Correction for several tests: the probability of any false positive is at most 5 %.",
    "ICC": "Intraclass correlation: the share of the variance that is between people. 1: repeated "
    "measurements of a person agree exactly.",
    "inverse LQR": "The classical method: it identifies cost weights as if torque were unlimited.",
    "left-out trials": "Each trial is predicted by a model that was fitted to the other trials "
    "only.",
    "model predictive control": "At every sample the controller plans a short time ahead within "
    "its limits, and carries out the first step of the plan.",
    "neural delay": "Conduction time of nerves, modelled as a chain of internal states. Their "
    "single gains have no meaning.",
    "profile likelihood": "Interval of one number: all values that the recordings do not "
    "contradict when the other numbers are fitted again.",
    "residual": "Recorded minus modelled output.",
    "RMS": "Root mean square: the size of a signal.",
    "SEM": "Standard error of measurement: standard deviation of repeated results of one person.",
    "typical": "Root mean square in these recordings.",
    "variance accounted for": _VAF,
    "VAF": f"Variance accounted for: {_VAF}",
}


@dataclass
class Glossary:
    """Adds tooltips to the text of one page."""

    _explained: set[str] = field(default_factory=set)

    def marked(self, text: str) -> str:
        """The `text` with a tooltip at each term that has none on the page yet."""
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
