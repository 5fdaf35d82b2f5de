"""`palpate run press`: a probe presses an organ."""
