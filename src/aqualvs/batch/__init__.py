"""Many dives at once: the `aqualvs batch` command.

Imports the pipeline, workers and net_survey.
"""
