"""The folder of a run: posture.csv, points, run.yaml, statistics, and the rule of overwriting.

Imports the scanner, nets and sources.
"""
