"""Control of the vehicle: controllers, missions, gains and safety.

Imports the scanner; uses no link and no thread.
"""
