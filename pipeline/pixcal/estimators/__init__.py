"""From samples to fringe parameters: scout, sweep, gauge, combination of sets."""
