"""The `aqualvs follow` and `aqualvs tune` commands: the closed loop, simulated and on a vehicle.

Imports control, simulation and live.
"""
