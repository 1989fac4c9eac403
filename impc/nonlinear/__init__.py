"""The fit of an optimal control problem of the user's own: settings, result, page."""
