"""The `aqualvs check` and `aqualvs doctor` commands: whether a rig and a machine are ready.

Imports everything but the experiments.
"""
