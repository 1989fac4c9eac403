"""Words that pages use and not every reader knows: each page ends with those that stand in it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html import unescape

from markupsafe import Markup, escape

#: Word -> what it means. A word is found in any case of its first letter, and in the plural.
WORDS: dict[str, str] = {
    "A-optimal": "Of experiments: with the least mean variance of the logarithms of the cost "
    "weights.",
    "AIC": "Akaike's information criterion: misfit plus a penalty for each number that was "
    "fitted. Less is better; differences below 2 say nothing.",
    "analytic centre": "Of all weights with the same gain the one that is farthest from the edge "
    "of their set. It does not depend on units.",
    "ANOVA": "Analysis of variance: splits the spread of measurements into parts, between people, "
    "between conditions, and what is left.",
    "bootstrap": "Intervals by repetition: the fit is repeated on recordings that are made again "
    "from its own residuals.",
    "bound": "The most that the subject can do, as the settings give it: no command is larger.",
    "CMC": "Coefficient of multiple correlation: how alike whole curves are, 1 at most.",
    "coloured": "Of a residual: neighbouring samples resemble each other, as those of people do.",
    "condition number": "Largest over smallest eigenvalue of the weights: how unequally they "
    "penalise directions. It depends on units.",
    "cost weight": "An entry on the diagonal of Q or R: what the square of a state or command "
    "costs.",
    "D-optimal": "Of experiments: with the least determinant of the covariance of the cost "
    "weights, the smallest volume of uncertainty.",
    "direction of the gain": "A combination of entries of the gain. Recordings determine some "
    "combinations well although no entry by itself.",
    "dominant direction": "The combination of states on which the weights set the highest cost "
    "weight.",
    "dominant cost": "The largest part of the cost: the combination of states with the highest "
    "cost weight.",
    "dwell": "For how long a perturbation keeps each of its values.",
    "eigenvalue": "Of weights: the cost weight of one of the combinations of states that are "
    "penalised apart.",
    "ETFE": "Empirical transfer function estimate: response over perturbation at each frequency.",
    "FIM": "Fisher's information matrix: what the recordings identify of the parameters, its "
    "inverse being the least variance.",
    "gain": "K of the law u = -K x: how much command the controller gives for each state where no "
    "bound interferes.",
    "Hedges' g": "Difference of two means over their standard deviation, corrected for small "
    "groups.",
    "Holm's correction": "Makes p-values of several questions larger, so that all together err in "
    "5 of 100 only.",
    "horizon": "How many samples the controller looks ahead.",
    "ICC": "Intraclass correlation: the share of the spread of measurements that is between "
    "people. 1: a second visit finds the same order of people.",
    "inverse LQR": "Weights from recordings as if no bound were ever reached.",
    "inverse MPC": "Weights from recordings with the bounds: the controller that would have moved "
    "the same way inside them.",
    "kappa": "The condition number of all weights together, Q and R.",
    "LASSO": "A fit that pays for each parameter that leaves its nominal value, so that few do.",
    "left out": "Predicted by a fit of the other trials: what a fit is worth on what it has not "
    "seen.",
    "Ljung and Box": "A test of whether a residual is white; a small p-value says that it is not.",
    "LQR": "Linear-quadratic regulator: the controller that minimises the sum of penalised "
    "squares when nothing is bounded.",
    "MDC": "Minimal detectable change: a person's change between two visits that is larger than "
    "the test's own scatter, at 95 %.",
    "MPC": "Model predictive control: at each sample the best plan over the horizon inside the "
    "bounds, of which the first step is done.",
    "natural coordinates": "States in units in which noise at the input moves all of them alike.",
    "natural size": "How large an entry of the gain would be if its state alone made the whole "
    "command.",
    "p-value": "How often chance alone would show as much; below 0.05 it is seldom believed to be "
    "chance.",
    "profile likelihood": "Interval of one number: how far it can be moved, all others fitted "
    "again, until the recordings object.",
    "QR": "A factorisation of a matrix; pivoted, it takes first the columns that add most.",
    "RMS": "Root-mean-square: the size of a signal.",
    "SD": "Standard deviation.",
    "SEM": "Standard error of measurement: the scatter of one person's result.",
    "SI": "The international units: metre, kilogram, second, newton, radian.",
    "singular value": "How much recordings change along a combination of unknowns; the smaller it "
    "is, the less they say of that combination.",
    "SVD": "Singular value decomposition: a matrix as directions with a strength each.",
    "terminal set": "States from which the controller's law keeps all bounds for ever; the plan "
    "has to end there.",
    "trace": "Sum of the diagonal of a matrix.",
    "VAF": "Variance accounted for (3.24): 100 % when recorded and simulated coincide, 0 % when "
    "the simulation is no better than nothing.",
    "weights": "Q and R: what the controller pays for states and commands.",
    "white": "Of a residual: each sample independent of those before it, as a recorder's noise.",
}


@dataclass(frozen=True)
class Glossary:
    """The words of one page; each is linked where it stands first."""

    words: tuple[tuple[str, str], ...] = ()  # Word and what it means, in the order of the glossary
    _linked: set[str] = field(default_factory=set, compare=False)

    def anchor(self, word: str) -> str:
        """The id of a `word` on the page."""
        return "word-" + re.sub(r"\W+", "-", word.lower()).strip("-")

    def linked(self, text: str) -> str:
        """The `text` with links at the words that stand on the page for the first time."""
        if isinstance(text, Markup) or not self.words:
            return text
        left = {word for word, _ in self.words if word in WORDS} - self._linked
        found = {word: match for word in left if (match := _pattern(word).search(text))}
        pieces, start = [], 0
        for word, match in sorted(found.items(), key=lambda item: (item[1].start(), -len(item[0]))):
            if match.start() < start:  # within a longer word
                continue
            self._linked.add(word)
            link = Markup('<a class="word" href="#{}">{}</a>').format(self.anchor(word), match[0])
            pieces += [escape(text[start : match.start()]), link]
            start = match.end()
        return Markup("").join([*pieces, escape(text[start:])])


def used_words(page: str) -> tuple[tuple[str, str], ...]:
    """The words of the glossary that stand in the text of a `page`, with their meanings."""
    text = unescape(re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL))
    found: set[str] = set()
    while True:  # what explains a word may use another
        new = {word for word in WORDS if word not in found and _pattern(word).search(text)}
        if not new:
            return tuple((word, WORDS[word]) for word in WORDS if word in found)
        found |= new
        text = " ".join(WORDS[word] for word in new)


def _pattern(word: str) -> re.Pattern[str]:
    first = word[0]
    begin = re.escape(first) if word[:2].isupper() else f"[{first.lower()}{first.upper()}]"
    plural = "" if word.isupper() else "s?"
    return re.compile(rf"(?<!\w){begin}{re.escape(word[1:])}{plural}(?!\w)")
