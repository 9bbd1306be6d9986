"""The `aqualvs calibrate` and `aqualvs board` commands.

Imports calibration, sources, results and report.
"""
