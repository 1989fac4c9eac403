"""Peak memory of one W2 fit in a process of its own: python -m experiments.benchmarks.memory 30."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from experiments.benchmarks.workloads import seat
from impc.inverse.table31 import inverse_mpc_reduced

__all__ = ["peak_megabytes"]


def peak_megabytes(seconds: float) -> float:
    """Peak resident memory of a process that fits a recording of `seconds`, MB."""
    call = [sys.executable, "-m", "experiments.benchmarks.memory", str(seconds)]
    answer = subprocess.run(call, capture_output=True, text=True, check=True)
    return float(answer.stdout)


if __name__ == "__main__":
    duration = float(sys.argv[1])
    if duration > 0:
        inverse_mpc_reduced(seat(seconds=duration).problem)
    # Peak of this program alone (Linux only); ru_maxrss would include its parent.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(float(status.split("VmHWM:")[1].split()[0]) / 1024)
