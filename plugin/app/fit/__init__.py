"""`palpate fit`: constants of tissue from what was measured."""
