"""The bar of all commands: what is told when it is interrupted, also where no bar is drawn."""

from __future__ import annotations

import pytest

from impc.cli.progress import progress


@pytest.mark.parametrize("begun", [0, 3])
def test_an_interruption_says_how_much_is_kept(begun: int) -> None:
    with (
        pytest.raises(KeyboardInterrupt, match=f"{begun + 2} of 9"),
        progress(9, "step", lambda count: f"{count} of 9", begun) as done,
    ):
        done("a")
        done("b")
        raise KeyboardInterrupt


def test_without_anything_kept_nothing_is_said() -> None:
    with pytest.raises(KeyboardInterrupt) as caught, progress(1, "step") as done:
        done("a")
        raise KeyboardInterrupt
    assert caught.value.args == ()
