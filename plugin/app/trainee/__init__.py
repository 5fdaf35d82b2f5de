"""People who train: a record of what they do, their learning curves, their data."""
