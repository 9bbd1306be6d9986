"""The condition of a net: lattice, twine, coverage, holes, and where on the net they are.

Imports scanning and vehicle_logs; writes no files.
"""
