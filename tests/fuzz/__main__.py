"""`python -m tests.fuzz [--seed N] [--cases N] [--only TARGET]`: hours of mutated input.

Prints its seed first. A case that ends in anything but one line is kept in results/fuzz and named;
the count of reasons says how often a reading process ended, or took too much memory or time.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

from tests.fuzz.targets import TARGETS, Fuzzer

_KEPT = Path("results", "fuzz")


def main() -> int:
    """Run; 1 when a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4), "little"))
    parser.add_argument("--cases", type=int, default=160_000, help="of all targets together")
    parser.add_argument("--only", choices=TARGETS, action="append", help="may be given again")
    given = parser.parse_args()
    names = given.only or list(TARGETS)
    print(f"seed {given.seed}, {given.cases} cases of {', '.join(names)}", flush=True)
    warnings.simplefilter("error")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(Path(folder), random.Random(given.seed))
        for name in names:
            failed += _run(fuzzer, name, given.cases // len(names), given.seed)
    print(f"{failed} failed")
    return min(failed, 1)


def _run(fuzzer: Fuzzer, name: str, cases: int, seed: int) -> int:
    reasons: Counter[str] = Counter()
    failed, slowest, begin = 0, 0.0, time.process_time()
    for case in range(cases):
        path, read = TARGETS[name](fuzzer)
        before = time.process_time()
        try:
            reasons[_kind(fuzzer.reason(read))] += 1
        except Exception:  # anything: that is what is looked for
            failed += 1
            _KEPT.mkdir(parents=True, exist_ok=True)
            kept = _KEPT / f"{seed}-{case}-{path.name}"
            shutil.copy(path, kept)
            print(f"FAILED {kept}: {traceback.format_exc(limit=-2)}", flush=True)
        slowest = max(slowest, time.process_time() - before)
    here, readers = (
        resource.getrusage(who).ru_maxrss / 1e6
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    print(
        f"{name}: {cases} cases, {failed} failed, {time.process_time() - begin:.0f} s of computing,"
        f" the slowest {slowest:.1f} s; at most {here:.2f} GB here and {readers:.2f} GB in readers"
        " that have ended"
    )
    for reason, times in reasons.most_common():
        print(f"  {times:7d}  {reason or 'read'}")
    sys.stdout.flush()
    return failed


def _kind(reason: str) -> str:
    """The reason without what is of one case only."""
    end = re.search(r"ends the process that reads it \(\w+\)|takes (more|longer) than", reason)
    if end:
        return end[0]
    return "damaged" if "damaged" in reason else "refused" if reason else ""


if __name__ == "__main__":
    raise SystemExit(main())
