"""The numerical tests on other linear algebra: `make numerics`, and how it is identified.

    python -m tests.numerics PYTHON...

Each Python (an environment with the oldest or the newest dependencies) runs the files below under
every kind of processor that OpenBLAS has kernels for and this one can run, on one and two threads.
Other kernels sum in another order: a verdict that changes with them is one that rounding gave.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Zen has the kernels of Haswell: 182 results of 13 sizes up to 400 are the same bit for bit.
CORES = ("Haswell", "SkylakeX", "Sandybridge")
THREADS = ("1", "2")
#: Numbers and no files, pages or commands. No slow tests.
FILES = (
    "tests/plants",
    "tests/studies/reliability/test_icc.py",
    "tests/studies/reliability/test_transfer.py",
    "tests/studies/selection/test_fisher.py",
    "tests/studies/selection/test_methods.py",
    "tests/assess/test_measures.py",
    "tests/control/test_closed_loop.py",
    "tests/inverse/test_residuals.py",
    "tests/inverse/test_equivalent_weights.py",
    "tests/inverse/test_noisy_fit.py",
    "tests/control/test_hard_plants.py",
    "tests/experiments/test_inverse_kkt.py",
    "tests/inverse/test_inverse_lqr.py",
    "tests/inverse/test_table31.py",
    "tests/model/test_riccati.py",
    "tests/control/test_casadi_controller.py",
    "tests/control/test_solvers.py",
    "tests/control/test_terminal_set.py",
    "tests/assess/test_input_limits.py",
    "tests/assess/test_bounded_weights.py",
)
# Kernels that the processor does not have end the process, by a signal.
_PROBE = """
import numpy, scipy.linalg
M = numpy.random.default_rng(0).normal(size=(64, 64))
scipy.linalg.eigh(M @ M.T), scipy.linalg.svd(M), numpy.linalg.solve(M, M)
"""


def main(pythons: list[str]) -> int:
    """Run all; the number of runs that failed."""
    failed = 0
    for python in pythons:
        for core in CORES:
            if _run([python, "-c", _PROBE], core, "1").returncode < 0:
                print(f"{python} {core}: skipped, this processor cannot run it", flush=True)
                continue
            for threads in THREADS:
                command = [python, "-m", "pytest", "-m", "not slow and not full", "-n", "2"]
                given = ["-p", "no:cacheprovider", "--dist", "loadfile", *FILES]
                done = _run([*command, *given], core, threads)
                lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines()
                print(f"{python} {core} {threads}: {lines[-1]}", flush=True)
                failed += done.returncode != 0
                if done.returncode:
                    print(done.stdout + done.stderr, file=sys.stderr)
    return failed


def _run(command: list[str], core: str, threads: str) -> subprocess.CompletedProcess[str]:
    chosen = {
        "OPENBLAS_CORETYPE": core,
        "OPENBLAS_NUM_THREADS": threads,
        "PYTHONPATH": str(ROOT),
        # numba's cache holds code of one version of numba and numpy.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    return subprocess.run(
        command, cwd=ROOT, env=os.environ | chosen, capture_output=True, text=True, check=False
    )


if __name__ == "__main__":
    sys.exit(min(1, main(sys.argv[1:])))
