"""The page to train on: its server, a process for each, what it shows."""
