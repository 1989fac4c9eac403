"""Actuation from command to torque: a delay and a first-order muscle as linear systems.

    command u -> Padé approximation of exp(-tau_d s) -> 1 / (tau_m s + 1) -> torque

The Padé approximant is realised as a lossless ladder from the continued fraction of the hyperbolic
tangent. The companion form would be ill-conditioned: for order 5 and a delay of 80 ms the
coefficients of the polynomials span ten decades. Delay and muscle: Table 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plants._checks import Array, finite_number, whole_number

#: Largest order of a Padé approximant; order 10 is exact to 1e-15 if delay times frequency is 1.6.
MAX_DELAY_ORDER = 20


@dataclass(frozen=True)
class LinearSystem:
    """A continuous linear system with one input and one output, dx/dt = Ax + Bu, y = Cx + Du.

    Attributes
    ----------
    A, B, C : Array
        Shapes (n, n) in 1/s, (n,) in 1/s, (n,).
    D : float
        Direct feedthrough.
    """

    A: Array
    B: Array
    C: Array
    D: float

    def response(self, frequency: float) -> complex:
        """Return the transfer function at a frequency in rad/s."""
        resolvent = 1j * frequency * np.eye(len(self.B)) - self.A
        return complex(self.C @ np.linalg.solve(resolvent, self.B) + self.D)


def pade_delay(delay: float, order: int) -> LinearSystem:
    r"""Realise the [order/order] Padé approximant of exp(-delay s).

    With t(s) the approximant of tanh(delay s / 2), the approximant of the delay is
    (1 - t) / (1 + t), and t is the truncated continued fraction

        t = 1 / (2/z + 1 / (6/z + 1 / (10/z + ...))),    z = delay s,

    a ladder of ``order`` lossless elements a_k^2 = 4k - 2, terminated by a resistance. With m_k = 1
    if order - k is even and 0 otherwise, and J_kj = (1 - m_k) m_j for j > k, its realisation is

        A = diag(a) (J - J' - m m') diag(a) / delay,   B = a m / delay,
        D = (-1)^order,                                C = -2 D (a m)'.

    It satisfies A + A' = -2 delay B B' and C' = -2 delay D B: both Gramians are multiples of the
    identity, the best conditioned form of an all-pass system. The states have the unit of the
    input.

    Parameters
    ----------
    delay : float
        Delay in s, positive.
    order : int
        From 0 (no delay) to ``MAX_DELAY_ORDER``. Positive orders have direct feedthrough, because
        the approximant is all-pass.

    Returns
    -------
    LinearSystem
        System with ``order`` states.

    Raises
    ------
    ValueError
        If the delay or the order is out of range.

    Notes
    -----
    The continued fraction is by Lambert (1761); its even and odd convergents are the diagonal Padé
    approximants of the exponential.
    """
    delay = finite_number("delay", delay, "give it in seconds; order 0 is no delay", above=0.0)
    order = whole_number(
        "order", order, "5 is exact to 2e-8 up to 1.6 / delay", least=0, most=MAX_DELAY_ORDER
    )
    k = np.arange(1, order + 1)
    a = np.sqrt(4.0 * k - 2.0)
    m = ((order - k) % 2 == 0).astype(float)
    J = np.triu(np.outer(1 - m, m), k=1)
    D = -1.0 if order % 2 else 1.0
    return LinearSystem(
        A=a[:, None] * (J - J.T - np.outer(m, m)) * a / delay,
        B=a * m / delay,
        C=-2.0 * D * a * m,
        D=D,
    )


def delayed_muscle(delay: float, time_constant: float, order: int) -> LinearSystem:
    """Connect the Padé delay and the muscle 1 / (time_constant s + 1) in series.

    Parameters
    ----------
    delay, time_constant : float
        In s, positive.
    order : int
        Order of the Padé approximant, see `pade_delay`.

    Returns
    -------
    LinearSystem
        Input command and output torque in N m. The states are those of the delay, then the muscle
        torque, all in N m; ``D`` is 0.

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    time_constant = finite_number("time_constant", time_constant, "give it in seconds", above=0.0)
    chain = pade_delay(delay, order)
    n = order + 1
    A = np.zeros((n, n))
    A[:-1, :-1] = chain.A
    A[-1] = np.append(chain.C, -1.0) / time_constant
    return LinearSystem(
        A=A,
        B=np.append(chain.B, chain.D / time_constant),
        C=np.eye(n)[-1],
        D=0.0,
    )
