"""What a person types: the `palpate` command. Nothing imports it."""
