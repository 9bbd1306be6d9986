"""Processes that measure a dive together: partition, pool, messages, frame results.

Imports the scanner, sources and results.
"""
