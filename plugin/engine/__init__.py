"""The engine plugin: all that knows an mjModel or an mjData. No formula of its own."""
