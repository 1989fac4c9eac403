"""Assessment of estimates: goodness of fit, intervals, sets of weights, intent."""
