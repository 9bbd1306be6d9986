"""The folder of a run: posture.csv, points, run.yaml, summaries, and the rule of overwriting.

Imports the scanner, nets and sources.
"""
