"""What one more function says of an estimate: agreement, intervals, sets of weights, intent."""
