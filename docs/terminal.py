"""Commands and pictures in the tutorials, which run when the site is built.

`terminal` runs a line as a shell would and prints what it prints; `show` puts a picture that a
command wrote under the block. Both work in `docs/_results`, the folder of all tutorials.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "_results"
_WAITING: list[Path] = []


def terminal(line: str, *, status: int = 0, last: int | None = None) -> None:
    """Run one command in the folder of results.

    Parameters
    ----------
    line : str
        As typed.
    status : int
        What it is to end with.
    last : int, optional
        Print that many lines from the end only.
    """
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
    lines = said.rstrip().splitlines()
    shown = lines if last is None else lines[-last:]
    print("\n".join((["..."] if len(shown) < len(lines) else []) + shown))


def write(name: str, text: str) -> None:
    """Write a text file into the folder of results, and print it."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / name).write_text(text)
    print(text)


def change(name: str, old: str, new: str) -> None:
    """Do what an editor would do: replace a text in a file."""
    text = (RESULTS / name).read_text()
    if old not in text:
        raise RuntimeError(f"{name} has no {old!r}")
    (RESULTS / name).write_text(text.replace(old, new))
    print(f"{name}: {old!r} is {new!r} now")


def show(name: str) -> None:
    """Put a picture of the folder of results under this block."""
    _WAITING.append(RESULTS / name)


class Pictures:
    """sphinx-gallery asks this for the pictures of a block."""

    def __repr__(self) -> str:
        """Of no address: sphinx-gallery keeps it to see whether the setting changed."""
        return "Pictures"

    def __call__(
        self, block: tuple[Any, ...], block_vars: dict[str, Any], gallery_conf: dict[str, Any]
    ) -> str:
        """Copy what is waiting beside the page; return the directives."""
        from sphinx_gallery.scrapers import figure_rst  # noqa: PLC0415

        copied = []
        for picture in _WAITING:
            named = Path(next(block_vars["image_path_iterator"]))
            target = named.with_suffix(picture.suffix)
            shutil.copyfile(picture, target)
            copied.append(str(target))
        _WAITING.clear()
        return str(figure_rst(copied, gallery_conf["src_dir"])) if copied else ""


def figures_page() -> str:
    """Every figure that the tutorials' commands wrote, and the command that draws it: Markdown."""
    parts = [_HEAD]
    for report in sorted(RESULTS.glob("*/report.html")):
        folder = report.parent
        pictures = sorted(folder.glob("figures/*.svg"))
        if not pictures:
            continue
        command = _command(report.read_text(encoding="utf-8")) or f"impc {folder.name}"
        parts.append(f"## `{' '.join(command.split()[:2])}`\n\n```text\n{command}\n```\n")
        for picture in pictures:
            title = picture.stem.replace("-", " ").replace("_", " ")
            place = f"_results/{folder.name}/figures/{picture.name}"
            parts.append(f"```{{figure}} {place}\n:alt: {title}\n\n")
            parts.append(f"{title.capitalize()} (`figures/{picture.name}`)\n```\n")
    return "\n".join(parts)


def _command(page: str) -> str:
    """As a report says how it was made, or empty."""
    found = re.search(r"<code>(impc [^<]*)</code>", page)
    return found.group(1).strip() if found else ""


_HEAD = """\
# Every figure, and the command that draws it

The pictures of the tutorials, made when this site was built. Each is written as SVG, with `--pdf`
as PDF too. `report.html` of the same folder says what each one shows.
"""
