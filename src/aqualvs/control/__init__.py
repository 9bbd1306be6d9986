"""Control of the vehicle: controllers, missions, gains and safety.

Imports the scanner; knows no link and no thread.
"""
