"""Compiled models: an organ's declaration is read, and the model made to fit."""
