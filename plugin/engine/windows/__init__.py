"""Windows: what MuJoCo sees of an organ are small flexes that slide over it."""
