"""The constrained controller: its rows, its closed loop and the derivatives of both."""

from __future__ import annotations

from impc.settings_files import ignore_settings_files

# Must run before a module of this package imports numba, whose settings file could load compiled
# code from the working folder.
ignore_settings_files("numba")
