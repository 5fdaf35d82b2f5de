"""Exercises in many worlds at once; `vector.Exercises` is what `gymnasium.make_vec` makes."""
