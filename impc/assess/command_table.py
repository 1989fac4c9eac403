"""The gain of a fit beside the one by regression on recorded commands, with its intervals."""

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
    """Gain by regression of recorded commands on the states, with 95 % intervals, beside a fit's.

    Only samples count at which the fitted controller meets no bound within its horizon. The
    intervals are for recording noise of the commands of any colour, and for noise of the person
    that is white: the states follow any other. Noise in recorded states makes this gain too small.
    Where the two differ by much, an assumption of one fails (docs/fitting.md).

    Parameters
    ----------
    estimate : Estimate
        Of recordings with commands.

    Returns
    -------
    pandas.DataFrame
        A row for each entry of the gain, by name: `unit`, `fitted`, `regression`, `low`, `high`.

    Raises
    ------
    DataError
        When no commands were recorded.
    SolverError
        When the samples without a bound do not determine a gain, or the plant does not follow its
        commands.

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
    import pandas as pd  # noqa: PLC0415  # a third of a second

    plant = estimate.problem.plant
    found = regress_commands(estimate.problem, estimate.gain, estimate.metric)
    table = np.concatenate(found.deviations)
    inverse = np.linalg.inv(table.T @ table)
    # Row t of the sum is (1 (x) x_t (X'X)^-1), an entry of K by an entry of the residual.
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
