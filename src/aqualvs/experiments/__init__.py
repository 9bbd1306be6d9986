"""Experiments: the paper reproduced, ablations, simulated dives, the public benchmark set.

Imports every other package but the command line.
"""
