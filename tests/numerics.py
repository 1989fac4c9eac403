"""The numerical tests on other linear algebra: `make numerics`, and how it is told.

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
CORES = ("Haswell", "SkylakeX", "Sandybridge", "Zen")
THREADS = ("1", "2")
#: Numbers and no files, pages or commands. No slow tests.
FILES = (
    "tests/plants",
    "tests/reliability/test_icc.py",
    "tests/reliability/test_spectra.py",
    "tests/reliability/test_tests.py",
    "tests/selection/test_information.py",
    "tests/selection/test_methods.py",
    "tests/test_agreement.py",
    "tests/test_closed_loop.py",
    "tests/test_eigenvalue_ranges.py",
    "tests/test_equivalent_weights.py",
    "tests/test_exact_mpc.py",
    "tests/test_fitted_controller.py",
    "tests/test_hard_plants.py",
    "tests/test_inverse_kkt.py",
    "tests/test_inverse_lqr.py",
    "tests/test_inverse_mpc.py",
    "tests/test_lqr.py",
    "tests/test_mpc.py",
    "tests/test_nonlinear_mpc.py",
    "tests/test_random_inverse.py",
    "tests/test_semidefinite.py",
    "tests/test_terminal_set.py",
    "tests/test_unknown_limit.py",
    "tests/test_weights_set.py",
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
                command = [python, "-m", "pytest", "-m", "not slow", "-p", "no:cacheprovider"]
                done = _run([*command, "-n", "2", "--dist", "loadfile", *FILES], core, threads)
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
