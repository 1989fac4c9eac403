"""Commands and figures in the examples, which run in `docs/_results` when the site is built."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "_results"
_WAITING: list[Path] = []


def terminal(line: str, *, status: int = 0) -> None:
    """Run a command line in the folder of results and print its output."""
    RESULTS.mkdir(exist_ok=True)
    beside = Path(sys.executable).parent
    path = os.pathsep.join([str(beside), os.environ.get("PATH", "")])
    done = subprocess.run(
        shlex.split(line, comments=True),
        cwd=RESULTS,
        env={**os.environ, "PATH": path, "COLUMNS": "80"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != status:
        raise RuntimeError(f"{line}\nended with {done.returncode}:\n{done.stdout}{done.stderr}")
    said = (done.stdout + done.stderr).replace(f"{RESULTS}{os.sep}", "")
    print(said.rstrip())


def write(name: str, text: str) -> None:
    """Write a text file into the folder of results, and print it."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / name).write_text(text)
    print(text)


def show(name: str) -> None:
    """Show a figure of the folder of results under this block."""
    _WAITING.append(RESULTS / name)


class Pictures:
    """Image scraper of sphinx-gallery for the figures given to `show`."""

    def __repr__(self) -> str:
        """Without an address, because sphinx-gallery compares settings between builds."""
        return "Pictures"

    def __call__(
        self, block: tuple[Any, ...], block_vars: dict[str, Any], gallery_conf: dict[str, Any]
    ) -> str:
        """Copy the figures next to the page and return their directives."""
        from sphinx_gallery.scrapers import figure_rst  # noqa: PLC0415

        copied = []
        for picture in _WAITING:
            named = Path(next(block_vars["image_path_iterator"]))
            target = named.with_suffix(picture.suffix)
            shutil.copyfile(picture, target)
            copied.append(str(target))
        _WAITING.clear()
        return str(figure_rst(copied, gallery_conf["src_dir"])) if copied else ""
