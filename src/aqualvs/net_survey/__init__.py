"""The `aqualvs net` and `aqualvs net-change` commands: one survey of a net, and what changed since.

Imports nets, results and report.
"""
