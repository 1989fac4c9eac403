"""Compare the misfit of fits with that of the true controller, random plants, VAF of 90 %.

Each recording of `random_recording` is fitted from the default start, and the misfit of its weights
is compared with that of the true controller at its own initial state. A fit in another local
minimum has a larger misfit. One hundredth of the power of the noise is a tenth of a point of VAF.

    python -m experiments.misfit_ceiling --inputs 3 --first 0 --count 100
"""

from __future__ import annotations

import argparse

import numpy as np
from tqdm import tqdm

from experiments.printed_intervals import fit, random_recording
from impc.control.controller import Controller
from impc.errors import ImpcError
from impc.inverse.residuals import residual_only
from impc.model.recordings import Recording
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = ["short_of_truth"]


def short_of_truth(truth: Controller, trial: Recording) -> float:
    """Residual power of the fit above that of the truth, %."""
    settings = FitSettings(horizon=truth.horizon, u_max=list(truth.bounds.u_max))
    problem = fit_problem(truth.plant, [trial], settings)
    ours = fit(truth, trial).misfit
    theirs = float(np.linalg.norm(residual_only(problem, np.array(truth.K), np.array(truth.S))))
    return 100 * ((ours / theirs) ** 2 - 1)


def main() -> None:
    """Fit the plants and print those with a larger misfit than the truth."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    chosen = parser.parse_args()
    tried = short = 0
    for seed in tqdm(range(chosen.first, chosen.first + chosen.count), disable=None):
        try:
            beyond = short_of_truth(*random_recording(seed, chosen.inputs, 90.0))
        except ImpcError as error:
            print(f"{seed}: {error}", flush=True)
            beyond = float("inf")
        tried, short = tried + 1, short + (beyond > 1)
        if beyond > 1:
            print(f"{seed}: leaves {beyond:.2g} % more than the truth", flush=True)
    print(
        f"{chosen.inputs} inputs: {tried - short} of {tried} leave at most 1 % more than the truth"
    )


if __name__ == "__main__":
    main()
