"""The command line: one module a command, with its signature and a thin body.

Modules here import nothing heavy at the top, so that `--help` answers at once.
"""
