"""The live loop, its health, outputs, MAVLink and the pilot's page.

Imports sources, control, recording and results.
"""
