"""Fitted gain next to the gain by regression on recorded commands, with intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.assess.long_run_covariance import residual_noise, spread_of_sum
from impc.assess.printed_gain import LEVEL, entry_names
from impc.checking import checked
from impc.inverse.command_regression import regress_commands
from impc.model.plant import gain_unit

if TYPE_CHECKING:
    import pandas as pd

    from impc.inverse.estimates import Estimate


@checked
def command_regression(estimate: Estimate) -> pd.DataFrame:
    """Compare a fitted gain with the gain by regression on recorded commands.

    Only samples count at which the fitted controller has no active bound over its horizon. The 95 %
    intervals assume recording noise in the commands (any autocorrelation) and white noise of the
    subject; coloured noise is correlated with the states and biases them. Noise in recorded states
    shrinks the regression gain. If both gains differ by much, an assumption of one of them fails.

    Parameters
    ----------
    estimate : Estimate
        Fit of recordings with commands.

    Returns
    -------
    pandas.DataFrame
        One row per entry of the gain, by name: `unit`, `fitted`, `regression`, `low`, `high`.

    Raises
    ------
    DataError
        If no commands were recorded.
    SolverError
        If the samples with inactive bounds do not determine a gain, or the plant driven by the
        commands does not follow the recordings.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> run = truth.simulate([1.0], steps=20)
    >>> trial = impc.Recording(plant, run.x, commands=run.u)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> impc.command_regression(found).round(3).loc["K.u[0].x[0]", "regression"]
    np.float64(0.538)
    """
    import pandas as pd  # noqa: PLC0415

    plant = estimate.problem.plant
    found = regress_commands(estimate.problem, estimate.gain, estimate.metric)
    table = np.concatenate(found.deviations)
    inverse = np.linalg.inv(table.T @ table)
    # Row t of the sum is (1 (x) x_t (X'X)^-1): an entry of K by an entry of the residual.
    along = [np.einsum("tn,ij->tijn", part @ inverse, np.eye(plant.m)) for part in found.deviations]
    columns = [part.reshape(len(part), plant.m, -1) for part in along]
    spread = spread_of_sum(residual_noise(found.residuals), columns)
    half = scipy.special.ndtri(0.5 + LEVEL / 2) * np.sqrt(np.diag(spread))
    values = np.ravel(found.K)
    return pd.DataFrame(
        {
            "unit": [gain_unit(plant, u, x) for u in plant.controls for x in plant.states],
            "fitted": np.ravel(estimate.gain),
            "regression": values,
            "low": values - half,
            "high": values + half,
        },
        index=pd.Index(entry_names(plant), name="name"),
    )
