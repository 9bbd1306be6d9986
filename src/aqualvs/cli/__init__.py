"""The command line: signatures of the commands, grouped in modules, with thin bodies.

Modules here import nothing heavy at the top, so that `--help` answers at once.
"""
