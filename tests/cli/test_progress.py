"""The bar of all commands: what is told when it is interrupted, also where no bar is drawn."""

from __future__ import annotations

from typing import Any

import pytest

from impc.cli.progress import progress


def interrupted(*given: Any) -> None:
    with progress(*given) as done:
        done("a")
        done("b")
        raise KeyboardInterrupt


@pytest.mark.parametrize("begun", [0, 3])
def test_an_interruption_says_how_much_is_kept(begun: int) -> None:
    with pytest.raises(KeyboardInterrupt, match=f"{begun + 2} of 9"):
        interrupted(9, "step", lambda count: f"{count} of 9", begun)


def test_without_anything_kept_nothing_is_said() -> None:
    with pytest.raises(KeyboardInterrupt) as caught:
        interrupted(2, "step")
    assert caught.value.args == ()
