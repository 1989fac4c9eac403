"""Peak memory of one W2 fit or Jacobian in a process of its own.

python -m experiments.benchmarks.memory fit 30
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from experiments.benchmarks.workloads import seat
from impc.inverse.laws import GainLaw
from impc.inverse.table31 import inverse_mpc_reduced
from impc.inverse.unknowns import linear_at

__all__ = ["peak_megabytes"]


def peak_megabytes(what: str, seconds: float) -> float:
    """Peak resident memory of a process that does `what` for a recording of `seconds`, MB."""
    call = [sys.executable, "-m", "experiments.benchmarks.memory", what, str(seconds)]
    answer = subprocess.run(call, capture_output=True, text=True, check=True)
    return float(answer.stdout)


if __name__ == "__main__":
    asked, duration = sys.argv[1], float(sys.argv[2])
    work = seat(seconds=duration) if duration > 0 else None
    if work is not None and asked == "fit":
        inverse_mpc_reduced(work.problem)
    elif work is not None:
        law = GainLaw(work.problem, np.array(work.controller.K), np.array(work.controller.S))
        linear_at(work.problem, law, law.start)
    # Peak of this program alone (Linux only); ru_maxrss would include its parent.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(float(status.split("VmHWM:")[1].split()[0]) / 1024)
