"""Memory, time and report size of `impc fit` with many trials of ten seconds.

    python -m experiments.benchmarks.many_trials 500

The subject is the simulated seated one. No trial is held out, because each would need a fit of its
own. Half an hour.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

__all__ = ["measure"]

_AT_ONCE = 84  # `impc simulate` makes at most 99
_IMPC = (sys.executable, "-m", "impc")


def measure(trials: int, folder: Path) -> dict[str, float]:
    """Simulate `trials` in a `folder`, fit them as one subject; measured values in MB and s."""
    files: list[str] = []
    for seed in range(-(-trials // _AT_ONCE)):
        out = folder / f"{seed}"
        options = ["--duration", "10", "--formats", "csv", "--seed", f"{seed}"]
        count = min(_AT_ONCE, trials - len(files))
        call = [*_IMPC, "simulate", "seated-balance", "--trials", f"{count}", "--out", str(out)]
        subprocess.run([*call, *options], check=True, stdout=subprocess.DEVNULL)
        for number in range(1, count + 1):
            path = folder / f"trial_{len(files) + 1}.csv"
            (out / f"trial_{number}.csv").rename(path)
            files.append(str(path))
    config = folder / "subject.toml"
    text = (folder / "0" / "subject.toml").read_text(encoding="utf-8")
    config.write_text(text.replace("[fit]", "[fit]\nheld_out = false"), encoding="utf-8")
    results = folder / "fit"
    call = [*_IMPC, "fit", *files, "--plant", "seated-balance", "--config", str(config), "--yes"]
    running = subprocess.Popen([*call, "--out", str(results)], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(running.pid, 0)
    running.returncode = os.waitstatus_to_exitcode(status)
    if running.returncode:
        raise RuntimeError(f"impc fit ended with {running.returncode}")
    return {
        "peak memory, MB": used.ru_maxrss / 1024,  # KiB on Linux
        "time on one core, s": used.ru_utime + used.ru_stime,
        "report.html, MB": (results / "report.html").stat().st_size / 1e6,
        "result.json, MB": (results / "result.json").stat().st_size / 1e6,
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for what, value in measure(int(sys.argv[1]), Path(place)).items():
            print(f"{what}: {value:.3g}")
