"""Exercises in which tissue comes free of what it has grown on to."""
